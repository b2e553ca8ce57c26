// SPDX-License-Identifier: MIT
// Rows of contacts in the system of bodies on a CPU: forces, and the product with their stiffness. They are never part of the stored A,
// whose pattern follows from the mesh. Input: backends/contact.py; law: kernels/contact_law.cuh.
#pragma once
#include <cstdint>

#include "contact_passes.cuh"
#include "own_surface.cuh"
#include "edge_detection.cuh"
#include "pass_choice.cuh"
#include "ties.cuh"
#include "triangle_shape.cuh"

struct RowState {                 // of a row in the step under way
    double s[3];                  // displacement of its point by the velocities reached, relative to the other surface [m]
    double step[3];               // by the solution of the pass [m]
    double limit;                 // normal force that limits friction, held in a pass [N]
    int32_t in_set;               // 1: counts as closed in the first pass
    double dual[3];               // friction force with which the pass linearizes friction [N]
    double stiffness[6];          // upper triangle of the force's slope times h^2, world frame [kg]
    ContactForce force;
};

struct ContactReport {            // of a body in a step
    int32_t contacts;             // rows that carry force
    int32_t passes;               // solves
    int32_t clipped;              // its nodes held back at an obstacle, beside the law, and places where its island is held apart
    double residual;              // of the system with the law as it is at the end, relative; NaN: nothing was touched
    double work;                  // of contact on the body [J]
};

struct SolveResult;

struct OwnReference {       // of a body (own_contact.h)
    double range;           // up to which distances are measured; 0: there is no reference [m]
    double rotation[9];     // since then
    double least;           // of the distances measured [m]
    double most, most_in_step;  // of what nodes have moved since, and in this step alone, but for rigid motions [m]
};

struct OwnContact {         // of bodies with themselves (own_contact.h)
    OwnTables near;
    const int32_t *start, *node;        // (bodies + 1,), nodes of surfaces, by body
    double* reference;                  // (nodes of surfaces, 3) [m]
    double *strain, *moved;             // (nodes,) moved since the reference, but for rigid motions: up to the start of the step, in all [m]
    double *clear, *edge_clear;         // (sites,), (edges,) distances measured at the reference [m]
    double *apart, *edges_apart;        // (sites,), (edges,) distances at the start of the step, or less [m]
    OwnReference* body;                 // (bodies,)
};

struct Contact {
    ObstacleTable obstacles;
    int32_t obstacle_count;
    int32_t passes;
    double tolerance;
    double dx_dv, force_coefficient;              // [s]
    const int32_t* body_start;                    // (bodies + 1,) rows against obstacles
    int32_t* corner;                              // (rows, 4)
    double* weight;                               // (rows, 4)
    int32_t* obstacle;                            // (rows,) obstacle or other body
    double *normal, *gap, *drift, *entry;         // (rows, 3), (rows,), (rows, 3), (rows,)
    double *stiffness, *friction, *thickness, *hardening;  // (rows,)
    double *force, *traction;                     // (rows,), (rows, 3)
    const double *rotation, *predictor, *free;    // (nodes, 3, 3), (nodes, 3), (nodes,)
    RowState* state;                              // (rows,)
    int32_t *active, *used;                       // (rows,) rows that act, and that are not empty; those of an island one after another
    double* room;                                 // 27 doubles a node
    ContactReport* report;                        // (bodies,)
    double* reaction;                             // (bodies, obstacles, 6) force and torque on each obstacle
    int32_t* dropped;                             // (sites,)
    const double* mass;                           // (nodes,) [kg]
    const double* body_thickness;                 // (bodies,) [m], where bodies touch each other
    const int32_t* face_start;                    // (bodies + 1,) rows of triangles against obstacles; null: there are none (faces.h)
    const int32_t *face, *face_owns;              // (faces, 3) nodes, (faces,) bits
    const double* face_friction;                  // (bodies, obstacles)
    int32_t between;                              // 1: bodies touch each other; else at most themselves
    int32_t pair_first;                           // row of the first one between bodies; -1: there are none
    const int32_t* edge_start;                    // (bodies + 1,) rows of edges against edges of other bodies; null: there are none
    const int32_t *edge, *edge_opposite, *triangle_edge;  // (edges, 2), (edges, 2), (triangles, 3): edge_detection.cuh
    const double* edge_length;                    // (bodies,)
    EdgeWings* wings;                             // (edges,)
    int32_t* facing;                              // (rows of edges,)
    const int32_t* row_body;                      // (rows,)
    const int32_t *site_body, *node_site;         // (sites,), (nodes,) or -1
    const int32_t* triangle;                      // (triangles, 3) nodes
    const int32_t *tree_start, *tree_child;       // (bodies + 1,), (tree, 2): two children, or ~ of a triangle (pairs.h)
    Box *tree_box, *body_box;                     // (tree,), (bodies,)
    int32_t *near, *was_near, *touched;           // (bodies,) bits: its box meets another's, it may touch itself; in the last step; it got rows by a sweep
    const double* pair_friction;                  // (bodies, bodies)
    const double* gravity;                        // (3,)
    int32_t *island, *island_start;               // (bodies,) bodies by island; (bodies + 1,)
    int32_t* island_rows;                         // (bodies,) first entry in `active` of each island
    int32_t islands;
    SolveResult* result;                          // (bodies,)
    PassChoice* choice;                           // (bodies,)
    int32_t most_modes;                           // of the coarse space of an island; 0: none
    double *modes, *coarse, *lever;               // (nodes, 18), (most_modes + 4, most_modes), (rows, 8): island.h
    int32_t* mode;                                // (bodies,) first mode of a body; -1: it has none
    const int32_t* unheld;                        // (bodies,) 1: no node is fixed
    Ties ties;
    OwnContact own;
};

static void rotated(const double* R, const double* v, double* out) {
    for (int i = 0; i < 3; ++i) out[i] = R[3 * i] * v[0] + R[3 * i + 1] * v[1] + R[3 * i + 2] * v[2];
}
static void rotated_back(const double* R, const double* v, double* out) {
    for (int i = 0; i < 3; ++i) out[i] = R[i] * v[0] + R[3 + i] * v[1] + R[6 + i] * v[2];
}

inline bool is_tie(const Contact& c, int row) { return c.ties.count > 0 && row >= c.ties.first; }

// Whether it is a row between two bodies.
inline bool is_pair(const Contact& c, int row) {
    if (is_tie(c, row)) return joins_bodies(c.ties, row - c.ties.first);
    return c.pair_first >= 0 && row >= c.pair_first;
}

// True if corner a of a row is of the other one of its two bodies.
inline bool is_other_side(const Contact& c, int row, int a) {
    return is_pair(c, row) && a > (!is_tie(c, row) && c.edge_start && row >= c.edge_start[0]);
}

// Body of a row; other: the other one, of a row between bodies.
inline int body_of_row(const Contact& c, int row, bool other) {
    if (is_tie(c, row)) return c.ties.body[2 * (row - c.ties.first) + (other && is_pair(c, row))];
    return other ? c.obstacle[row] : c.row_body[row];
}

// f(first, last) of the rows of contact that a body has with others, each sort
template <class F> void each_pair_range_of(const Contact& c, int body, F f) {
    if (c.pair_first >= 0) f(c.pair_first + c.body_start[body], c.pair_first + c.body_start[body + 1]);
    if (c.edge_start) f(c.edge_start[body], c.edge_start[body + 1]);
}

// f(first, last) of its rows against obstacles
template <class F> void each_obstacle_range_of(const Contact& c, int body, F f) {
    f(c.body_start[body], c.body_start[body + 1]);
    if (c.face_start) f(c.face_start[body], c.face_start[body + 1]);
}

template <class F> void each_range_of(const Contact& c, int body, F f) {
    each_obstacle_range_of(c, body, f);
    each_pair_range_of(c, body, f);
    if (c.ties.count) f(c.ties.first + c.ties.start[body], c.ties.first + c.ties.start[body + 1]);
}

// Which of a point's two rows, `pair` and the next one, something that it enters gets: its own, an empty one, or the one that carries less.
// normal: of two rows of the same other body the one that lies more along it.
inline int row_for(const Contact& c, int pair, int other, const double* normal = nullptr) {
    const bool both = normal && c.obstacle[pair] == other && c.obstacle[pair + 1] == other;
    if (both) return pair + (dot3(c.normal + 3 * (pair + 1), normal) > dot3(c.normal + 3 * pair, normal));
    if (c.obstacle[pair] == other) return pair;
    const bool next = c.obstacle[pair + 1] == other || c.obstacle[pair + 1] < 0;
    return pair + (next || (c.obstacle[pair] >= 0 && c.state[pair + 1].force.normal < c.state[pair].force.normal));
}

// How nodes move in the step, from positions x; y: solution found, material frame; null: before the solve.
inline SurfaceMotion<double, double> motion_of(const Contact& c, const double* x, const double* y) {
    return {x, c.predictor, y, c.rotation, c.free, c.dx_dv, c.force_coefficient, c.gravity};
}

// A row that a sweep has made has no force, and friction no limit, until a solve has found them.
inline void take_anew(RowState& state) {
    state.limit = 0;
    for (double& f : state.dual) f = 0;
    state.in_set = 0;
    state.force = {0, {0, 0, 0}, 0, false};
}

// Rows of one system. Vectors are nodal, material frame, and begin at node `node_first`.
struct Rows {
    const Contact& c;
    int32_t node_first;
    const int32_t* active;      // rows that act; of the last `apply_law`
    int32_t actives;

    ContactRow row(int r) const {
        return {c.normal + 3 * r, c.drift + 3 * r, c.traction + 3 * r, c.gap[r], c.thickness[r],
                c.hardening[r] * c.stiffness[r], c.friction[r]};
    }
    bool empty(int r) const { return c.obstacle[r] < 0; }
    // set: the row counts as closed whatever its gap
    ContactForce force(int r, const double* s, double limit, bool set) const {
        return is_tie(c, r) ? force_of_tie(c.ties, r - c.ties.first, s) : contact_force(row(r), s, limit, set);
    }
    void stiffness(int r, const ContactForce& f, const double* dual, double scale, double* k) const {
        if (is_tie(c, r)) stiffness_of_tie(c.ties, r - c.ties.first, scale, k);
        else contact_stiffness(row(r), f, dual, scale, k);
    }

    // f(node, weight) of the corners that may move
    template <class F> void each_corner(int r, F f) const {
        for (int a = 0; a < CORNERS; ++a) {
            const int node = c.corner[CORNERS * r + a];
            if (node >= 0 && c.free[node] != 0) f(node, c.weight[CORNERS * r + a]);
        }
    }
    // out += sum_a weight_a R_a v_a, world frame
    void gather(int r, const double* v, double* out) const {
        each_corner(r, [&](int node, double weight) {
            double w[3];
            rotated(c.rotation + 9 * (int64_t)node, v + 3 * (int64_t)(node - node_first), w);
            for (int k = 0; k < 3; ++k) out[k] += weight * w[k];
        });
    }
    // to_a += weight_a R_a^T f, f in the world frame
    void scatter(int r, const double* f, double* to) const {
        each_corner(r, [&](int node, double weight) {
            double w[3];
            rotated_back(c.rotation + 9 * (int64_t)node, f, w);
            for (int k = 0; k < 3; ++k) to[3 * (int64_t)(node - node_first) + k] += weight * w[k];
        });
    }
    // sum_a weight_a field_a of nodal vectors in the world frame, (nodes, 3)
    void at_point(int r, const double* field, double* out) const {
        out[0] = out[1] = out[2] = 0;
        for (int a = 0; a < CORNERS; ++a) {
            const int node = c.corner[CORNERS * r + a];
            for (int k = 0; k < 3 && node >= 0; ++k) out[k] += c.weight[CORNERS * r + a] * field[3 * (int64_t)node + k];
        }
    }
    static void stiff(const double* k, const double* u, double* out) {
        out[0] = k[0] * u[0] + k[1] * u[1] + k[2] * u[2];
        out[1] = k[1] * u[0] + k[3] * u[1] + k[4] * u[2];
        out[2] = k[2] * u[0] + k[4] * u[1] + k[5] * u[2];
    }
    bool acts(int r) const {
        const RowState& s = c.state[r];
        return s.force.closed || s.force.slip > 0;
    }
    // y += H^T S H x; returns x . H^T S H x
    double add_product(const double* x, double* y) const {
        double sum = 0;
        for (int k = 0; k < actives; ++k) {
            const int r = active[k];
            double u[3] = {0, 0, 0}, f[3];
            gather(r, x, u);
            stiff(c.state[r].stiffness, u, f);
            scatter(r, f, y);
            sum += dot3(u, f);
        }
        return sum;
    }
    // Adds the parts on the nodes' own blocks, those of nodes up to `last`. blocks: (nodes, 9)
    void add_diagonal(double* blocks, int last) const {
        auto own = [&](int i, int j) { return i == j && i >= node_first && i < last ? blocks + 9 * (int64_t)(i - node_first) : nullptr; };
        for (int k = 0; k < actives; ++k) add_blocks(active[k], c.state[active[k]].stiffness, own);
    }
    // Adds w_a w_b R_a^T S R_b to block_of(i, j), which may be null, over all pairs of the row's nodes.
    template <class F> void add_blocks(int r, const double* s, F block_of) const {
        const double S[9] = {s[0], s[1], s[2], s[1], s[3], s[4], s[2], s[4], s[5]};
        each_corner(r, [&](int i, double wi) {
            each_corner(r, [&](int j, double wj) {
                double* block = block_of(i, j);
                if (!block) return;
                const double *Ri = c.rotation + 9 * (int64_t)i, *Rj = c.rotation + 9 * (int64_t)j;
                for (int k = 0; k < 3; ++k)
                    for (int l = 0; l < 3; ++l) {
                        double sum = 0;
                        for (int m = 0; m < 3; ++m)
                            for (int n = 0; n < 3; ++n) sum += Ri[3 * m + k] * S[3 * m + n] * Rj[3 * n + l];
                        block[3 * k + l] += wi * wj * sum;
                    }
            });
        });
    }
};
