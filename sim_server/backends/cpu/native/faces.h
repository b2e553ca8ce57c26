// SPDX-License-Identifier: MIT
// Triangles of surfaces against obstacles on a CPU (kernels/face_detection.cuh): rows where an obstacle comes near between the corners,
// before a solve, and after it the sweep of the paths that it found.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

#include "face_detection.cuh"
#include "island_rows.h"

// The triangles of a body and the ways of their corners in a step.
struct BodyFaces {
    const Loop& loop;
    Contact& c;
    const FaceTables tables;
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
        : loop(loop), c(c),
          tables{c.obstacles, c.obstacle_count, c.face_start, c.face, c.face_owns, c.face_friction, c.node_site, c.corner, c.weight, c.obstacle,
                 c.normal, c.gap, c.drift, c.entry, c.stiffness, c.friction, c.thickness, c.hardening, c.force, c.traction},
          body(body), first(c.face_start[body]), last(c.face_start[body + 1]), memory(kept()) {
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
        from_radius = sphere_around(start, from);
        to_radius = sphere_around(stop, to);
    }
    static Memory& kept() {
        static thread_local Memory memory;
        return memory;
    }
    const int32_t* nodes_of(int row) const { return nodes_of_face(tables, row); }
    bool held(int row) const {
        const int32_t* node = nodes_of(row);
        return c.free[node[0]] == 0 && c.free[node[1]] == 0 && c.free[node[2]] == 0;
    }

    // f(row, ways of its corners) of the triangles that may move, where a body may come nearer than `reach` to an obstacle
    template <class F> void each_face(int obstacle, double reach, F f) const {
        if (c.obstacles.kind[obstacle] == PLANE || first == last) return;
        if (stays_far(c.obstacles, obstacle, from, from_radius, to, to_radius, reach)) return;
        for (int k = first; k < last; ++k) {
            if (held(k)) continue;
            const NodeWay* ways[3];
            ways_of(k, obstacle, ways);
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
    void ways_of(int row, int obstacle, const NodeWay** ways) const {
        for (int a = 0; a < 3; ++a) ways[a] = &way(nodes_of(row)[a], obstacle);
    }
    void count_dropped(int row) const {
        if (const int site = site_of_face(tables, row); site >= 0) ++c.dropped[site];
    }
};

struct FaceDetection {
    const Loop& loop;
    Contact& c;

    // Sets the rows of a step.
    void run() const {
        Team::each(loop.threads, loop.bodies, [&](int i) { detect(i); });
    }
    void detect(int body) const {
        const BodyFaces faces(loop, c, motion_of(c, loop.x, nullptr), body);
        static thread_local std::vector<FaceTouch> found;
        found.assign(faces.last - faces.first, {-1, NEVER, 0, 0, {}, {}});
        for (int o = 0; o < c.obstacle_count; ++o)
            faces.each_face(o, 2 * thickness_of(body), [&](int k, const NodeWay* const* ways) {
                if (consider_face(faces.tables, k, o, ways, found[k - faces.first])) faces.count_dropped(k);
            });
        for (int k = faces.first; k < faces.last; ++k) {
            const FaceTouch& t = found[k - faces.first];
            if (t.obstacle < 0) {
                empty_face_row(faces.tables, k);
                continue;
            }
            const NodeWay* ways[3];
            faces.ways_of(k, t.obstacle, ways);
            set_face_row(faces.tables, loop.x, body, k, t, ways);
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
                const FaceTouch t = passage_of_face(faces.tables, k, o, ways, &time);
                if (t.obstacle >= 0) f(k, t, ways, time);
            });
    }

    // Gives triangles that y takes into an obstacle a row there. Returns whether there are such.
    bool sweep() const {
        bool found = false;
        for (int m = 0; m < count && c.face_start; ++m) {
            const BodyFaces faces(loop, c, motion_of(c, loop.x, y), bodies[m]);
            each_passage(faces, [&](int k, const FaceTouch& t, const NodeWay* const* ways, double) { found = take_row(faces, k, t, ways) || found; });
        }
        return found;
    }
    // False if the row holds another obstacle.
    bool take_row(const BodyFaces& faces, int k, const FaceTouch& t, const NodeWay* const* ways) const {
        if (!take_face_row(faces.tables, loop.x, faces.body, k, t, ways, c.state[k].force.normal > 0)) {
            faces.count_dropped(k);
            return false;
        }
        take_anew(c.state[k]);
        return true;
    }

    // Sets triangles that y takes into an obstacle back, to a part of the way. Returns whether there are such.
    bool clip() const {
        bool found = false;
        for (int m = 0; m < count && c.face_start; ++m) {
            const BodyFaces faces(loop, c, motion_of(c, loop.x, y), bodies[m]);
            each_passage(faces, [&](int k, const FaceTouch& t, const NodeWay* const* ways, double time) {
                for (int a = 0; a < 3; ++a) {
                    const int node = faces.nodes_of(k)[a];
                    if (c.free[node] == 0) continue;
                    const double* from = loop.x + 3 * (int64_t)node;
                    double back[3], dv[3];
                    place_before(c.obstacles, c.obstacle_count, t.obstacle, *ways[a], time, from, back, entry());
                    for (int l = 0; l < 3; ++l) dv[l] = (back[l] - from[l]) / c.dx_dv - c.predictor[3 * (int64_t)node + l];
                    rotated_back(c.rotation + 9 * (int64_t)node, dv, y + 3 * (int64_t)node);
                    found = true;
                }
            });
        }
        return found;
    }
};
