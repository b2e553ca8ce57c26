// SPDX-License-Identifier: MIT
// Rigid shapes of obstacles: signed distances, and the time at which a path comes near. The native loop and kernels share them.
//
// A shape has a frame of its own; poses (position, unit quaternion w, x, y, z) take it to the world. Distances are negative
// inside, normals are unit vectors out of the shape, lengths in m.
#pragma once
#include "host_device.cuh"
#ifndef __CUDACC_RTC__
#include <cmath>
#endif

// PLANE: the half-space y < 0. SPHERE: size radius. BOX: size half of each edge. CAPSULE: size radius, half of its axis, which is
// along y. GRID: size x, y, z of its first node, spacing; distances at its nodes, z fastest, trilinear in between.
enum ShapeKind { PLANE = 0, SPHERE = 1, BOX = 2, CAPSULE = 3, GRID = 4 };

struct ObstacleTable {
    const int* kind;      // (m,) ShapeKind
    const double* size;   // (m, 4)
    const double* grid;   // distances of all grids
    const int* place;     // (m,) first entry of each grid
    const int* cells;     // (m, 3) its nodes along x, y, z
    const double* begin;  // (m, 7) poses at the start of the step
    const double* end;    // (m, 7) and at its end
};

constexpr double NEVER = 2;  // entry time of a path that does not enter

HOST_DEVICE double dot3(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// R v for the rotation of a pose: v + 2 q x (q x v + w v).
HOST_DEVICE void world_vector(const double* pose, const double* v, double* out) {
    const double w = pose[3], x = pose[4], y = pose[5], z = pose[6];
    const double a = y * v[2] - z * v[1] + w * v[0], b = z * v[0] - x * v[2] + w * v[1], c = x * v[1] - y * v[0] + w * v[2];
    const double o[3] = {v[0] + 2 * (y * c - z * b), v[1] + 2 * (z * a - x * c), v[2] + 2 * (x * b - y * a)};
    for (int k = 0; k < 3; ++k) out[k] = o[k];
}

// Point x of the world in the shape's frame, and point p of the shape in the world's.
HOST_DEVICE void local_point(const double* pose, const double* x, double* p) {
    const double back[7] = {0, 0, 0, pose[3], -pose[4], -pose[5], -pose[6]};
    const double from[3] = {x[0] - pose[0], x[1] - pose[1], x[2] - pose[2]};
    world_vector(back, from, p);
}

HOST_DEVICE void world_point(const double* pose, const double* p, double* x) {
    world_vector(pose, p, x);
    for (int k = 0; k < 3; ++k) x[k] += pose[k];
}

// Makes `normal` a unit vector and returns the length that it had; +y where that is 0.
HOST_DEVICE double make_unit(double* normal) {
    const double length = sqrt(dot3(normal, normal));
    if (!(length > 0)) {
        normal[0] = normal[2] = 0;
        normal[1] = 1;
        return 0;
    }
    for (int k = 0; k < 3; ++k) normal[k] /= length;
    return length;
}

// Outside: to the nearest point of the box. Inside: to the nearest face.
HOST_DEVICE double distance_to_box(const double* half, const double* p, double* normal) {
    int face = 0;
    double out[3], away = 0;
    for (int k = 0; k < 3; ++k) {
        out[k] = fabs(p[k]) - half[k];
        if (out[k] > out[face]) face = k;
        normal[k] = out[k] > 0 ? (p[k] < 0 ? -out[k] : out[k]) : 0;
    }
    away = make_unit(normal);
    if (away > 0) return away;
    for (int k = 0; k < 3; ++k) normal[k] = k == face ? (p[k] < 0 ? -1 : 1) : 0;
    return out[face];
}

HOST_DEVICE double distance_to_capsule(double radius, double half, const double* p, double* normal) {
    const double y = p[1] < -half ? -half : p[1] > half ? half : p[1];
    normal[0] = p[0];
    normal[1] = p[1] - y;
    normal[2] = p[2];
    const double away = make_unit(normal);
    if (away == 0 && half > 0) {  // on the axis: to the side
        normal[0] = 1;
        normal[1] = 0;
    }
    return away - radius;
}

// Trilinear within the grid. Outside, with c the nearest point of the grid's box, D its distance, and d the distance there:
// sqrt(D^2 + d^2), at most the distance of the shape, since the box is convex and holds it.
HOST_DEVICE double distance_to_grid(const ObstacleTable& t, int obstacle, const double* p, double* normal) {
    const double *first = t.size + 4 * obstacle, *values = t.grid + t.place[obstacle];
    const int* nodes = t.cells + 3 * obstacle;
    const double spacing = first[3];
    double part[3], outside[3], square = 0;
    int low[3];
    for (int k = 0; k < 3; ++k) {
        const double at = (p[k] - first[k]) / spacing, last = nodes[k] - 1;
        const double inside = at > 0 ? (at < last ? at : last) : 0;  // NaN: 0
        low[k] = (int)inside;
        if (low[k] > nodes[k] - 2) low[k] = nodes[k] - 2;
        part[k] = inside - low[k];
        outside[k] = (at - inside) * spacing;
        square += outside[k] * outside[k];
    }
    const double* corner = values + ((long long)low[0] * nodes[1] + low[1]) * nodes[2] + low[2];
    const long long step[3] = {(long long)nodes[1] * nodes[2], nodes[2], 1};
    double distance = 0;
    for (int k = 0; k < 3; ++k) normal[k] = 0;
    for (int c = 0; c < 8; ++c) {
        const int up[3] = {c >> 2, c >> 1 & 1, c & 1};
        double weight[3];
        for (int k = 0; k < 3; ++k) weight[k] = up[k] ? part[k] : 1 - part[k];
        const double value = corner[up[0] * step[0] + up[1] * step[1] + up[2] * step[2]];
        distance += weight[0] * weight[1] * weight[2] * value;
        for (int k = 0; k < 3; ++k) normal[k] += (up[k] ? value : -value) * weight[(k + 1) % 3] * weight[(k + 2) % 3];
    }
    if (square > 0) {
        const double rest = distance > 0 ? distance : 0;
        for (int k = 0; k < 3; ++k) normal[k] = outside[k] != 0 ? outside[k] : rest * normal[k] / spacing;
        distance = sqrt(square + rest * rest);
    }
    make_unit(normal);
    return distance;
}

// Signed distance of point p from an obstacle, both in its frame. normal: at the nearest point of its surface; the nearest point
// is p - distance * normal (of a grid: to its accuracy).
HOST_DEVICE double distance_to(const ObstacleTable& t, int obstacle, const double* p, double* normal) {
    const double* size = t.size + 4 * obstacle;
    switch (t.kind[obstacle]) {
        case SPHERE: return distance_to_capsule(size[0], 0, p, normal);
        case BOX: return distance_to_box(size, p, normal);
        case CAPSULE: return distance_to_capsule(size[0], size[1], p, normal);
        case GRID: return distance_to_grid(t, obstacle, p, normal);
        default: break;
    }
    normal[0] = normal[2] = 0;
    normal[1] = 1;
    return p[1];
}

// The same where the path from -> to is at time s.
HOST_DEVICE double distance_at(const ObstacleTable& t, int obstacle, const double* from, const double* along, double s,
                               double* normal) {
    const double p[3] = {from[0] + s * along[0], from[1] + s * along[1], from[2] + s * along[2]};
    return distance_to(t, obstacle, p, normal);
}

// Of a convex shape: the distance along a line is a convex function, so that Newton's method from the left never passes its first
// root, however thin the shape and long the path. It takes one step to a face, and at a grazed edge a bit of the time in each.
HOST_DEVICE double entry_of_convex(const ObstacleTable& t, int obstacle, const double* from, const double* along, double above,
                                   double slope, double inflate) {
    double scale = inflate, s = 0, normal[3];
    for (int k = 0; k < 3; ++k) scale += fabs(from[k]) + fabs(along[k]) + t.size[4 * obstacle + k];  // unused sizes are 0
    const double rounding = 1e-15 * scale;
    for (int trial = 0; trial < 100 && slope < 0 && above > rounding; ++trial) {
        s -= above / slope;
        if (!(s <= 1)) return NEVER;
        above = distance_at(t, obstacle, from, along, s, normal) - inflate;
        slope = dot3(normal, along);
    }
    return slope < 0 || above <= rounding ? s : NEVER;
}

// Part [first, last] of the path in the grid's box, grown by `grow`; outside of it the distance is more than that.
HOST_DEVICE bool part_within(const ObstacleTable& t, int obstacle, const double* from, const double* along, double grow,
                             double* first, double* last) {
    const double* size = t.size + 4 * obstacle;
    *first = 0;
    *last = 1;
    for (int k = 0; k < 3; ++k) {
        const double low = size[k] - grow - from[k], high = size[k] + size[3] * (t.cells[3 * obstacle + k] - 1) + grow - from[k];
        if (along[k] == 0) {
            if (low > 0 || high < 0) return false;
            continue;
        }
        const double a = low / along[k], b = high / along[k];
        if ((a < b ? a : b) > *first) *first = a < b ? a : b;
        if ((a < b ? b : a) < *last) *last = a < b ? b : a;
    }
    return *first <= *last;
}

// Of a grid: steps that the slope of a trilinear function of distances, at most sqrt 3, allows, but at least a 16th of the spacing.
// What it may miss is a dip below the bound by less than a 20th of the spacing. A path that starts at or below `inflate` and leaves
// enters where it is first above and then falls to `inflate`, or gets a quarter of the spacing deeper than it began.
HOST_DEVICE double entry_of_grid(const ObstacleTable& t, int obstacle, const double* from, const double* along, double above,
                                 double inflate) {
    const double spacing = t.size[4 * obstacle + 3], length = sqrt(dot3(along, along)), least = spacing / 16;
    double normal[3], before, last, bound = above > 0 ? 0 : above - spacing / 4;
    if (!part_within(t, obstacle, from, along, inflate + least, &before, &last)) return NEVER;
    double s = before;
    above = distance_at(t, obstacle, from, along, s, normal) - inflate;
    for (int trial = 0; trial < 100000 && above > bound; ++trial) {
        if (above > 0) bound = 0;
        if (!(s < last)) return NEVER;
        const double safe = (above - bound) / 1.7320508075688772;
        before = s;
        s += (safe > least ? safe : least) / length;
        if (s > last) s = last;
        above = distance_at(t, obstacle, from, along, s, normal) - inflate;
    }
    for (int half = 0; half < 30; ++half) {  // the function is above the bound at `before`, not at s
        const double middle = (before + s) / 2;
        if (distance_at(t, obstacle, from, along, middle, normal) - inflate > bound) before = middle;
        else s = middle;
    }
    return s;
}

// First time in [0, 1] at which the path from -> to (in the frame of the obstacle) is at distance `inflate` >= 0, having been
// farther; NEVER without one. A path that starts at or below `inflate` and goes deeper enters at 0, one that leaves NEVER.
HOST_DEVICE double entry_time(const ObstacleTable& t, int obstacle, const double* from, const double* to, double inflate) {
    double normal[3];
    const double along[3] = {to[0] - from[0], to[1] - from[1], to[2] - from[2]};
    const double above = distance_to(t, obstacle, from, normal) - inflate, slope = dot3(normal, along);
    if (above <= 0 && slope < 0) return 0;
    if (t.kind[obstacle] == GRID) return dot3(along, along) > 0 ? entry_of_grid(t, obstacle, from, along, above, inflate) : NEVER;
    return above > 0 ? entry_of_convex(t, obstacle, from, along, above, slope, inflate) : NEVER;
}
