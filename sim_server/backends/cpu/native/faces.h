// SPDX-License-Identifier: MIT
// Triangles of surfaces against obstacles on a CPU (kernels/triangle_shape.cuh): rows where an obstacle comes near between the corners,
// before a solve, and after it the sweep of the paths that it found. A triangle has one row; its least distance on an edge counts for the
// triangle that owns the edge, and near a corner for the corner's own rows.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

#include "island_rows.h"

constexpr double ON_EDGE = 1e-9;      // a weight that is no more than rounding
constexpr double SAME_POINT = 0.25;   // difference of weights
constexpr int HOLDS = 10;             // rounds in which triangles are held back

// The triangles of a body and the ways of their corners in a step.
struct BodyFaces {
    const Loop& loop;
    Contact& c;
    const int body, first, last;      // rows
    struct Memory {
        std::vector<double> path;     // (nodes, 6) from, to
        std::vector<NodeWay> way;     // past the obstacle at hand
        std::vector<int32_t> known;   // 1 + the obstacle that `way` is past; 0: not even the path is known
        std::vector<int32_t> nodes;
    };
    Memory& memory;
    double from[3], to[3], from_radius, to_radius;  // spheres around the corners at the start and the end

    template <class Motion> BodyFaces(const Loop& loop, Contact& c, const Motion& motion, int body)
        : loop(loop), c(c), body(body), first(c.face_start[body]), last(c.face_start[body + 1]), memory(kept()) {
        const int begin = loop.body[body].first, count = loop.body[body].last - begin;
        if ((int)memory.known.size() < count) {
            memory.path.resize(6 * (size_t)count);
            memory.way.resize(count);
            memory.known.resize(count);
        }
        std::fill(memory.known.begin(), memory.known.begin() + count, -1);
        Box start = empty_box(), stop = start;
        for (int k = first; k < last; ++k)
            for (int a = 0; a < 3; ++a) {
                const int node = nodes_of(k)[a];
                if (memory.known[node - begin] == 0) continue;
                memory.known[node - begin] = 0;
                double *x = memory.path.data() + 6 * (int64_t)(node - begin), s[3];
                displacement_of(motion, node, s);
                for (int m = 0; m < 3; ++m) {
                    x[m] = loop.x[3 * (int64_t)node + m];
                    x[3 + m] = x[m] + s[m];
                }
                include(start, x, 0);
                include(stop, x + 3, 0);
            }
        from_radius = around(start, from);
        to_radius = around(stop, to);
    }
    static Memory& kept() {
        static thread_local Memory memory;
        return memory;
    }
    // Middle of a box; returns its distance from the corners.
    static double around(const Box& box, double* middle) {
        double half[3];
        for (int m = 0; m < 3; ++m) {
            middle[m] = 0.5 * (box.low[m] + box.high[m]);
            half[m] = 0.5 * (box.high[m] - box.low[m]);
        }
        return std::sqrt(dot3(half, half));
    }
    const int32_t* nodes_of(int row) const { return c.face + 3 * (row - c.face_start[0]); }
    bool held(int row) const {
        const int32_t* node = nodes_of(row);
        return c.free[node[0]] == 0 && c.free[node[1]] == 0 && c.free[node[2]] == 0;
    }

    // True if no corner can come nearer than `reach`: the paths of any two points differ by both radii at most.
    bool far_away(int obstacle, double reach) const {
        double begin[3], end[3], n[3];
        local_point(c.obstacles.begin + 7 * obstacle, from, begin);
        local_point(c.obstacles.end + 7 * obstacle, to, end);
        const double distance = distance_to(c.obstacles, obstacle, begin, n);
        for (int m = 0; m < 3; ++m) end[m] -= begin[m];
        return distance > std::sqrt(dot3(end, end)) + 2 * from_radius + to_radius + reach;
    }
    // f(row, ways of its corners) of the triangles that may move, where a body may come nearer than `reach` to an obstacle
    template <class F> void each_face(int obstacle, double reach, F f) const {
        if (c.obstacles.kind[obstacle] == PLANE || first == last || far_away(obstacle, reach)) return;
        for (int k = first; k < last; ++k) {
            if (held(k)) continue;
            const NodeWay* ways[3];
            for (int a = 0; a < 3; ++a) ways[a] = &way(nodes_of(k)[a], obstacle);
            if (is_finite(*ways[0]) && is_finite(*ways[1]) && is_finite(*ways[2])) f(k, ways);
        }
    }
    const NodeWay& way(int node, int obstacle) const {
        const int i = node - loop.body[body].first;
        if (memory.known[i] != obstacle + 1) {
            const double* x = memory.path.data() + 6 * (int64_t)i;
            memory.way[i] = way_of(c.obstacles, obstacle, x, x + 3);
            memory.known[i] = obstacle + 1;
        }
        return memory.way[i];
    }
    bool is_anothers(int row, const double* weight) const {
        for (int a = 0; a < 3; ++a)
            if (weight[(a + 2) % 3] <= ON_EDGE && !(c.face_owns[row - c.face_start[0]] >> a & 1)) return true;
        return false;
    }

    // Makes a row of where a triangle touches an obstacle. It has no forces.
    void put(int row, const FaceTouch& t) const {
        const int32_t* node = nodes_of(row);
        double at[3] = {0, 0, 0}, begin[3] = {0, 0, 0}, end[3] = {0, 0, 0}, stiffness = 0, share = 0;
        for (int a = 0; a < 3; ++a) {
            const double w = t.held[a], *x = loop.x + 3 * (int64_t)node[a];
            const NodeWay& by = way(node[a], t.obstacle);
            c.corner[CORNERS * row + a] = node[a];
            c.weight[CORNERS * row + a] = w;
            for (int m = 0; m < 3; ++m) {
                at[m] += w * x[m];
                begin[m] += t.weight[a] * by.begin[m];
                end[m] += t.weight[a] * by.end[m];
            }
            const int site = c.node_site[node[a]];
            if (site < 0) continue;  // a fixed node has no stiffness
            stiffness += w * c.stiffness[2 * site];
            share += w;
        }
        c.corner[CORNERS * row + 3] = -1;
        c.obstacle[row] = t.obstacle;
        c.gap[row] = plane_on_way(c.obstacles, t.obstacle, at, begin, end, t.time, c.normal + 3 * row, c.drift + 3 * row);
        c.entry[row] = t.entry;
        c.stiffness[row] = share > 0 ? stiffness / share : 0;
        c.friction[row] = c.face_friction[body * c.obstacle_count + t.obstacle];
        forget(row);
    }
    void forget(int row) const {
        c.force[row] = 0;
        c.hardening[row] = 1;
        std::fill(c.traction + 3 * row, c.traction + 3 * row + 3, 0.0);
    }
    void count_dropped(int row) const {
        for (int a = 0; a < 3; ++a)
            if (const int site = c.node_site[nodes_of(row)[a]]; site >= 0) { ++c.dropped[site]; return; }
    }
};

struct FaceDetection {
    const Loop& loop;
    Contact& c;

    // Sets the rows of a step.
    void run() const {
#pragma omp parallel for num_threads(loop.threads) schedule(dynamic, 1) if (loop.threads > 1)
        for (int i = 0; i < loop.bodies; ++i) detect(i);
    }
    void detect(int body) const {
        const BodyFaces faces(loop, c, motion_of(c, loop.x, nullptr), body);
        static thread_local std::vector<FaceTouch> found;
        found.assign(faces.last - faces.first, {-1, NEVER, 0, 0, {}, {}});
        for (int o = 0; o < c.obstacle_count; ++o)
            faces.each_face(o, 2 * thickness_of(body), [&](int k, const NodeWay* const* ways) {
                FaceTouch t = {-1, NEVER, 0, 0, {}, {}};
                if (c.obstacle[k] == o && c.force[k] > 0) t = face_stays(c.obstacles, o, ways, c.thickness[k], c.weight + CORNERS * k);
                if (t.obstacle < 0) {
                    t = face_touch(c.obstacles, o, ways, c.thickness[k]);
                    if (t.obstacle < 0 || faces.is_anothers(k, t.weight)) return;
                }
                FaceTouch& first = found[k - faces.first];
                if (first.obstacle >= 0) faces.count_dropped(k);
                if (comes_before(t, first)) first = t;
            });
        for (int k = faces.first; k < faces.last; ++k) {
            const FaceTouch& t = found[k - faces.first];
            if (t.obstacle < 0) {
                if (c.obstacle[k] < 0) continue;
                c.obstacle[k] = -1;
                c.entry[k] = NEVER;
                faces.forget(k);
                continue;
            }
            const RowMemory last = memory_of(c, k);
            faces.put(k, t);
            recall(c, k, &last, 1);
        }
    }
    double thickness_of(int body) const { return c.face_start[body] < c.face_start[body + 1] ? c.thickness[c.face_start[body]] : 0; }
};

// After the passes.
struct FaceSweep : IslandRows {
    FaceSweep(const IslandRows& of) : IslandRows(of) {}

    template <class F> void each_passage(const BodyFaces& faces, F f) const {
        for (int o = 0; o < c.obstacle_count; ++o)
            faces.each_face(o, 0, [&](int k, const NodeWay* const* ways) {
                double time;
                const FaceTouch t = face_passage(c.obstacles, o, ways, c.thickness[k], THROUGH * c.thickness[k], &time);
                if (t.obstacle >= 0 && !faces.is_anothers(k, t.held)) f(k, t, ways, time);
            });
    }

    // Gives triangles that y takes into an obstacle a row there. Returns whether there are such.
    bool sweep() const {
        bool found = false;
        for (int m = 0; m < count && c.face_start; ++m) {
            const BodyFaces faces(loop, c, motion_of(c, loop.x, y), bodies[m]);
            each_passage(faces, [&](int k, const FaceTouch& t, const NodeWay* const*, double) { found = take_row(faces, k, t) || found; });
        }
        return found;
    }
    // False if the row holds another obstacle.
    bool take_row(const BodyFaces& faces, int k, const FaceTouch& t) const {
        RowState& state = c.state[k];
        const bool same = c.obstacle[k] == t.obstacle;
        if (!same && c.obstacle[k] >= 0 && state.force.normal > 0) {
            faces.count_dropped(k);
            return false;
        }
        const double n[3] = {c.normal[3 * k], c.normal[3 * k + 1], c.normal[3 * k + 2]}, hardening = c.hardening[k];
        double moved = 0;
        for (int a = 0; a < 3; ++a) moved = std::max(moved, std::fabs(c.weight[CORNERS * k + a] - t.held[a]));
        faces.put(k, t);
        const bool harder = same && moved < SAME_POINT && dot3(n, c.normal + 3 * k) > SAME_PLANE;
        take_anew(state);
        if (same) c.hardening[k] = harder ? std::min(hardening * HARDER, HARDEST) : hardening;
        return true;
    }

    // Sets triangles that y takes into an obstacle back, to a part of the way; returns the number of their nodes.
    int clip() const {
        int clipped = 0;
        for (int m = 0; m < count && c.face_start; ++m) {
            const BodyFaces faces(loop, c, motion_of(c, loop.x, y), bodies[m]);
            each_passage(faces, [&](int k, const FaceTouch& t, const NodeWay* const* ways, double time) {
                for (int a = 0; a < 3; ++a) {
                    const int node = faces.nodes_of(k)[a];
                    if (c.free[node] == 0) continue;
                    double back[3], dv[3];
                    for (int l = 0; l < 3; ++l) back[l] = ways[a]->begin[l] + SHORT_OF * time * (ways[a]->end[l] - ways[a]->begin[l]);
                    world_point(c.obstacles.end + 7 * t.obstacle, back, back);
                    for (int l = 0; l < 3; ++l) dv[l] = (back[l] - loop.x[3 * (int64_t)node + l]) / c.dx_dv - c.predictor[3 * (int64_t)node + l];
                    rotated_back(c.rotation + 9 * (int64_t)node, dv, y + 3 * (int64_t)node);
                    ++clipped;
                }
            });
        }
        return clipped;
    }
};
