// SPDX-License-Identifier: MIT
// Triangles past obstacles on a GPU (kernels/face_detection.cuh), a thread for each: before a solve, and the sweep of the paths that it
// found; with FACE_ROWS.
#pragma once
#include "device_contact.cuh"
#include "face_detection.cuh"

typedef SurfaceMotion<real, local> FaceMotion;

__device__ __forceinline__ FaceTables face_tables(const ContactArguments& c) {
    return {c.obstacles, c.obstacle_count, c.faces.start, c.faces.node, c.faces.owns, c.faces.friction, c.faces.node_site,
            c.faces.corner, c.faces.weight, c.obstacle, c.normal, c.gap, c.drift, c.entry, const_cast<double*>(c.stiffness),
            const_cast<double*>(c.friction), const_cast<double*>(c.thickness), c.hardening, c.force, c.traction};
}
// solved: by c.y, else under gravity alone
__device__ __forceinline__ FaceMotion face_motion(const ContactArguments& c, bool solved) {
    return {c.x, c.predictor, solved ? c.y : nullptr, c.rotation, c.free, c.dx_dv, c.force_coefficient, c.faces.gravity};
}

struct FaceWays {       // of a triangle's corners in a step
    double from[3][3], to[3][3];
    double middle[2][3], radius[2];  // spheres around them at the start and the end
    bool held;          // it cannot move
    NodeWay way[3];     // past the obstacle at hand
    const NodeWay* ways[3];

    __device__ FaceWays(const ContactArguments& c, const FaceMotion& m, int r) {
        const int* node = c.faces.node + 3 * (r - c.faces.start[0]);
        Box start = empty_box(), stop = start;
        held = true;
        for (int a = 0; a < 3; ++a) {
            double s[3];
            place_of(m, node[a], from[a]);
            displacement_of(m, node[a], s);
            for (int k = 0; k < 3; ++k) to[a][k] = from[a][k] + s[k];
            include(start, from[a], 0);
            include(stop, to[a], 0);
            held = held && c.free[node[a]] == 0;
            ways[a] = way + a;
        }
        radius[0] = sphere_around(start, middle[0]);
        radius[1] = sphere_around(stop, middle[1]);
    }
    // Sets the ways past an obstacle. False if they do not come nearer than `reach`, or are not finite.
    __device__ __forceinline__ bool past(const ContactArguments& c, int obstacle, double reach) {
        if (held || c.obstacles.kind[obstacle] == PLANE) return false;
        if (stays_far(c.obstacles, obstacle, middle[0], radius[0], middle[1], radius[1], reach)) return false;
        look(c, obstacle);
        return is_finite(way[0]) && is_finite(way[1]) && is_finite(way[2]);
    }
    __device__ __forceinline__ void look(const ContactArguments& c, int obstacle) {
        for (int a = 0; a < 3; ++a) way[a] = way_of(c.obstacles, obstacle, from[a], to[a]);
    }
};

__device__ __forceinline__ void count_dropped_face(const ContactArguments& c, const FaceTables& t, int r) {
    if (const int site = site_of_face(t, r); site >= 0) atomicAdd(c.faces.dropped + site, 1);
}

// Sets the row of a triangle.
__device__ void detect_face(const ContactArguments& c, int body, int r) {
    const FaceTables t = face_tables(c);
    FaceWays ways(c, face_motion(c, false), r);
    FaceTouch first = {-1, NEVER, 0, 0, {}, {}};
    int last = -1;
    for (int o = 0; o < c.obstacle_count; ++o) {
        if (!ways.past(c, o, 2 * c.thickness[r])) continue;
        if (consider_face(t, r, o, ways.ways, first)) count_dropped_face(c, t, r);
        last = o;
    }
    if (first.obstacle < 0) return empty_face_row(t, r);
    if (last != first.obstacle) ways.look(c, first.obstacle);
    set_face_row(t, c.x, body, r, first, ways.ways);
}

// Gives a triangle that y takes into an obstacle a row there. Returns whether there is one.
__device__ bool sweep_face(const ContactArguments& c, int body, int r) {
    const FaceTables t = face_tables(c);
    FaceWays ways(c, face_motion(c, true), r);
    bool found = false;
    for (int o = 0; o < c.obstacle_count; ++o) {
        double time;
        if (!ways.past(c, o, 0)) continue;
        const FaceTouch touch = passage_of_face(t, r, o, ways.ways, &time);
        if (touch.obstacle < 0) continue;
        DeviceRow& row = c.row[r];
        if (!take_face_row(t, c.x, body, r, touch, ways.ways, row.force.normal > 0)) {
            count_dropped_face(c, t, r);
            continue;
        }
        row.limit = row.dual[0] = row.dual[1] = row.dual[2] = 0;
        row.in_set = 0;
        row.force = {0, {0, 0, 0}, 0, false};
        found = true;
    }
    return found;
}
