// SPDX-License-Identifier: MIT
// What of a surface may touch obstacles in a step (contact.py).
#include "kernel.h"
#include "contact_law.cuh"

struct Detect {
    int n;                   // surface nodes, two rows each
    int obstacles;           // their number, m
    const int* kind;         // (m,) as ObstacleTable in shapes.cuh has them, up to `end`
    const double* size;      // (m, 4)
    const double* grid;
    const int* place;        // (m,)
    const int* cells;        // (m, 3)
    const double* begin;     // (m, 7)
    const double* end;       // (m, 7)
    const double* swept;     // (m, 4) sphere around each in this step; radius < 0: it has no end
    const double* pair_friction;  // (bodies, m) coefficient of friction of each body on each obstacle
    const int* node;         // (n,) of the scene, ascending
    const int* body;         // (n,)
    const real* x;           // (nodes, 3) [m]
    const real* predictor;   // (nodes, 3) v: the step moves x by dx_dv (predictor + dv) [m/s]
    const real* free;        // (nodes,) 1, or 0 at fixed nodes
    const real* mass;        // (nodes,) [kg]
    const local* block;      // (nodes, 6) what elements have put into the node's own block of A [kg]
    const double* block_scale;  // (bodies,) of K in A of backward Euler over that in `block`
    const double* gravity;   // (3,) acceleration [m/s2]
    double force_coefficient;  // of backward Euler, which bodies take where they touch [s]
    double dx_dv;            // likewise [s]
    double kappa;            // stiffness of a contact over that of its node
    const double* thickness; // (2 n,) [m]
    int* obstacle;           // (2 n,) in, out: number of the obstacle of a row; -1: the row is empty
    double* normal;          // (2 n, 3) in, out
    double* gap;             // (2 n,) out [m]
    double* drift;           // (2 n, 3) out [m]
    double* entry;           // (2 n,) out
    double* stiffness;       // (2 n,) in, out: set in the first step [N/m]
    double* friction;        // (2 n,) out
    double* hardening;       // (2 n,) in, out
    double* force;           // (2 n,) in, out [N]
    double* traction;        // (2 n, 3) in, out [N]
    int* dropped;            // (n,) in, out: obstacles that there was no row for, summed over the steps
};

// A place where a node may touch an obstacle: the plane that stands for it.
struct Candidate {
    int obstacle;       // -1: none
    double entry;       // as a part of the step; NEVER
    double distance;    // at the start of the step [m]
    double point[3];    // touched, in the obstacle's frame
    double normal[3];   // there, too
};

INLINE bool comes_first(const Candidate& a, const Candidate& b) {
    return b.obstacle < 0 || a.entry < b.entry || (a.entry == b.entry && a.distance < b.distance);
}

// Looks for the plane of an obstacle for the path x -> x + s; obstacle -1 where the path stays away.
INLINE Candidate candidate_of(const ObstacleTable& t, int o, const double* x, const double* s, double thickness) {
    Candidate c = {-1, NEVER, 0, {}, {}};
    double from[3], to[3], way[3], stop[3];
    for (int k = 0; k < 3; ++k) stop[k] = x[k] + s[k];
    local_point(t.begin + 7 * o, x, from);
    local_point(t.end + 7 * o, stop, to);
    for (int k = 0; k < 3; ++k) way[k] = to[k] - from[k];
    c.distance = distance_to(t, o, from, c.normal);
    const double steepest = t.kind[o] == GRID ? 1.7320508075688772 : 1;  // slope of the distance
    if (!(c.distance - steepest * sqrt(dot3(way, way)) < 2 * thickness)) return c;
    double away = c.distance;
    c.entry = entry_time(t, o, from, to, thickness);
    if (c.entry <= 1) {
        for (int k = 0; k < 3; ++k) from[k] += c.entry * way[k];
        away = distance_to(t, o, from, c.normal);
    } else if (!(c.distance < 2 * thickness)) {
        return c;
    }
    for (int k = 0; k < 3; ++k) c.point[k] = from[k] - away * c.normal[k];
    c.obstacle = o;
    return c;
}

// What a row remembers of the last step.
struct Memory {
    int obstacle;
    double force, hardening, normal[3], traction[3];
};

INLINE Memory memory_of(const Detect& p, int row) {
    Memory m;
    m.obstacle = p.obstacle[row];
    m.force = p.force[row];
    m.hardening = p.hardening[row];
    for (int k = 0; k < 3; ++k) {
        m.normal[k] = p.normal[3 * row + k];
        m.traction[k] = p.traction[3 * row + k];
    }
    return m;
}

INLINE void put_row(const Detect& p, const ObstacleTable& t, int i, int row, const Candidate& c, const double* x,
                    const Memory* last) {
    double *normal = p.normal + 3 * row, *drift = p.drift + 3 * row, *traction = p.traction + 3 * row, from[3], to[3];
    p.obstacle[row] = c.obstacle;
    p.force[row] = p.gap[row] = p.friction[row] = 0;
    p.entry[row] = NEVER;
    p.hardening[row] = 1;
    for (int k = 0; k < 3; ++k) traction[k] = drift[k] = 0;
    if (c.obstacle < 0) return;
    world_vector(t.end + 7 * c.obstacle, c.normal, normal);
    world_point(t.begin + 7 * c.obstacle, c.point, from);
    world_point(t.end + 7 * c.obstacle, c.point, to);
    double gap = 0;
    for (int k = 0; k < 3; ++k) {
        drift[k] = to[k] - from[k];
        gap += normal[k] * (x[k] - to[k]);
    }
    p.gap[row] = gap;
    p.entry[row] = c.entry;
    p.friction[row] = p.pair_friction[p.body[i] * p.obstacles + c.obstacle];
    for (int r = 0; r < 2; ++r) {
        if (last[r].obstacle != c.obstacle) continue;
        p.force[row] = last[r].force;
        p.hardening[row] = last[r].hardening;
        for (int k = 0; k < 3; ++k) traction[k] = last[r].traction[k];
        turn_with(last[r].normal, normal, traction);
    }
}

KERNEL(detect, Detect) {
    const int node = p.node[i];
    const ObstacleTable t = {p.kind, p.size, p.grid, p.place, p.cells, p.begin, p.end};
    const double thickness = p.thickness[2 * i];
    double x[3], s[3], middle[3];
    for (int k = 0; k < 3; ++k) {  // where the node would go under gravity alone
        x[k] = p.x[3 * node + k];
        s[k] = p.dx_dv * (p.predictor[3 * node + k] + p.force_coefficient * p.gravity[k]);
        middle[k] = x[k] + s[k] / 2;
    }
    if (p.stiffness[2 * i] == 0) {
        const double stiff = (p.block[6 * node] + p.block[6 * node + 3] + p.block[6 * node + 5]) / 3;
        const double own = p.mass[node] + p.block_scale[p.body[i]] * stiff;
        p.stiffness[2 * i] = p.stiffness[2 * i + 1] = p.kappa * own / (p.force_coefficient * p.dx_dv);
    }
    const double reach = sqrt(dot3(s, s)) / 2 + 2 * thickness;
    Candidate first = {-1, NEVER, 0, {}, {}}, second = first;
    int found = 0;
    for (int o = 0; o < p.obstacles && p.free[node] != 0; ++o) {
        const double* ball = p.swept + 4 * o;
        const double off[3] = {middle[0] - ball[0], middle[1] - ball[1], middle[2] - ball[2]}, bound = reach + ball[3];
        if (ball[3] >= 0 && !(dot3(off, off) <= bound * bound)) continue;
        const Candidate c = candidate_of(t, o, x, s, thickness);
        if (c.obstacle < 0) continue;
        ++found;
        if (comes_first(c, first)) {
            second = first;
            first = c;
        } else if (comes_first(c, second)) {
            second = c;
        }
    }
    if (found > 2) p.dropped[i] += found - 2;
    if (first.obstacle < 0 && p.obstacle[2 * i] < 0 && p.obstacle[2 * i + 1] < 0) return;  // the rows are empty already
    const Memory last[2] = {memory_of(p, 2 * i), memory_of(p, 2 * i + 1)};
    put_row(p, t, i, 2 * i, first, x, last);
    put_row(p, t, i, 2 * i + 1, second, x, last);
}

struct Distances {
    int n;                // surface nodes
    int obstacles;        // their number, m
    const int* kind;      // (m,) as ObstacleTable in shapes.cuh has them, up to `end`
    const double* size;   // (m, 4)
    const double* grid;
    const int* place;     // (m,)
    const int* cells;     // (m, 3)
    const double* begin;  // (m, 7)
    const double* end;    // (m, 7)
    const int* node;      // (n,) of the scene
    const real* x;        // (nodes, 3) [m]
    double* distance;     // (n,) out: from the nearest obstacle where that is at the end of the step [m]
    int* nearest;         // (n,) out: its number
};

KERNEL(distances, Distances) {
    const ObstacleTable t = {p.kind, p.size, p.grid, p.place, p.cells, p.begin, p.end};
    double x[3], local_x[3], normal[3];
    for (int k = 0; k < 3; ++k) x[k] = p.x[3 * p.node[i] + k];
    for (int o = 0; o < p.obstacles; ++o) {
        local_point(t.end + 7 * o, x, local_x);
        const double distance = distance_to(t, o, local_x, normal);
        if (o > 0 && !(distance < p.distance[i])) continue;
        p.distance[i] = distance;
        p.nearest[i] = o;
    }
}
