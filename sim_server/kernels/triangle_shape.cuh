// SPDX-License-Identifier: MIT
// A triangle of a surface and an obstacle: the point of the triangle that is nearest to it, or deepest in it, and when a moving triangle
// comes near; shared by both devices. All in the frame of the obstacle; a triangle is 9 numbers, its corners one after another.
//
// The distance from a convex shape is a convex function. Outside of a sphere or capsule its least value over a triangle is that from a
// point or segment; outside of a box it is at a corner of either, or between two edges; inside of a box it is found by nested sections. Of
// a grid it is the least of samples no farther apart than its spacing, improved by descent (compare Macklin et al., Local Optimization
// for Robust Signed Distance Field Collision, 2020); parts of the triangle that cannot be below a bound are left out.
#pragma once
#include "edge_edge.cuh"
#include "vertex_triangle.cuh"

HOST_DEVICE_CALL double distance_from(const ObstacleTable& t, int obstacle, const double* p, double* normal) {
    return distance_to(t, obstacle, p, normal);
}

struct LeastPoint {
    double distance;    // signed
    double weight[3];   // of the corners
};

HOST_DEVICE void point_of(const double* triangle, const double* weight, double* p) {
    for (int k = 0; k < 3; ++k) p[k] = weight[0] * triangle[k] + weight[1] * triangle[3 + k] + weight[2] * triangle[6 + k];
}

HOST_DEVICE void lower(LeastPoint& least, double distance, double w0, double w1, double w2) {
    if (distance < least.distance) least = {distance, {w0, w1, w2}};
}

HOST_DEVICE void lower_to_point(const double* triangle, const double* p, LeastPoint& least) {
    double w[3], off[3];
    const double away = apart(p, triangle, triangle + 3, triangle + 6, w, off);
    lower(least, away, w[0], w[1], w[2]);
}

// The distance of the triangle's edges from the segment p -> q.
HOST_DEVICE void lower_to_segment(const double* triangle, const double* p, const double* q, LeastPoint& least) {
    for (int a = 0; a < 3; ++a) {
        const int b = (a + 1) % 3;
        double s, t, w[3] = {0, 0, 0};
        const double away = nearest_on_segments(triangle + 3 * a, triangle + 3 * b, p, q, &s, &t);
        w[a] = 1 - s;
        w[b] = s;
        lower(least, away, w[0], w[1], w[2]);
    }
}

// From the segment from y = -half to y = half of the axis, which may cross the triangle.
HOST_DEVICE_CALL LeastPoint least_to_axis(const double* triangle, double half) {
    const double low[3] = {0, -half, 0}, high[3] = {0, half, 0};
    LeastPoint least = {1e300, {1, 0, 0}};
    lower_to_point(triangle, low, least);
    if (!(half > 0)) return least;
    lower_to_point(triangle, high, least);
    lower_to_segment(triangle, low, high, least);
    double n[3];
    if (!normal_of(triangle, triangle + 3, triangle + 6, n) || n[1] == 0) return least;
    const double p[3] = {0, dot3(n, triangle) / n[1], 0};  // where the axis crosses the plane
    if (fabs(p[1]) <= half) lower_to_point(triangle, p, least);
    return least;
}

// True if a part of the triangle is in the box (clipped by its planes: Sutherland and Hodgman, 1974).
HOST_DEVICE_CALL bool crosses_box(const double* triangle, const double* half) {
    double in[30], out[30];
    int count = 3;
    for (int k = 0; k < 9; ++k) in[k] = triangle[k];
    for (int face = 0; face < 6 && count; ++face) {
        const int axis = face / 2, sign = face % 2 ? 1 : -1;
        int kept = 0;
        for (int i = 0; i < count; ++i) {
            const double *p = in + 3 * i, *q = in + 3 * ((i + 1) % count);
            const double a = sign * p[axis] - half[axis], b = sign * q[axis] - half[axis];
            if (a <= 0) {
                for (int k = 0; k < 3; ++k) out[3 * kept + k] = p[k];
                ++kept;
            }
            if ((a < 0 && b > 0) || (a > 0 && b < 0)) {
                for (int k = 0; k < 3; ++k) out[3 * kept + k] = p[k] + a / (a - b) * (q[k] - p[k]);
                ++kept;
            }
        }
        count = kept;
        for (int k = 0; k < 3 * count; ++k) in[k] = out[k];
    }
    return count > 0;
}

constexpr int SECTIONS = 36;  // of a search by golden sections: a part of 3e-8 of an edge is left

// Least value of a convex function along [0, 1], and where.
template <class F> HOST_DEVICE double least_along(F f, double* where) {
    const double golden = 0.6180339887498949;
    double low = 0, high = 1, a = 1 - golden, b = golden, at_a = f(a), at_b = f(b);
    for (int k = 0; k < SECTIONS; ++k) {
        if (at_a <= at_b) {
            high = b; b = a; at_b = at_a;
            a = high - golden * (high - low);
            at_a = f(a);
        } else {
            low = a; a = b; at_a = at_b;
            b = low + golden * (high - low);
            at_b = f(b);
        }
    }
    double best = at_a < at_b ? at_a : at_b;
    *where = at_a < at_b ? a : b;
    for (int end = 0; end < 2; ++end) {
        const double here = f((double)end);
        if (!(here < best)) continue;
        best = here;
        *where = end;
    }
    return best;
}

// Of any convex shape.
HOST_DEVICE_CALL LeastPoint least_by_sections(const ObstacleTable& t, int obstacle, const double* triangle) {
    auto along_row = [&](double u, double* v) {
        return least_along([&](double part) {
            const double w[3] = {(1 - u) * (1 - part), (1 - u) * part, u};
            double p[3], n[3];
            point_of(triangle, w, p);
            return distance_from(t, obstacle, p, n);
        }, v);
    };
    double u, v;
    least_along([&](double at) { return along_row(at, &v); }, &u);
    const double distance = along_row(u, &v);
    return {distance, {(1 - u) * (1 - v), (1 - u) * v, u}};
}

HOST_DEVICE_CALL LeastPoint least_to_box(const ObstacleTable& t, int obstacle, const double* triangle) {
    const double* half = t.size + 4 * obstacle;
    if (crosses_box(triangle, half)) return least_by_sections(t, obstacle, triangle);
    LeastPoint least = {1e300, {1, 0, 0}};
    double n[3];
    for (int a = 0; a < 3; ++a) lower(least, distance_from(t, obstacle, triangle + 3 * a, n), a == 0, a == 1, a == 2);
    for (int corner = 0; corner < 8; ++corner) {
        const double p[3] = {corner & 4 ? half[0] : -half[0], corner & 2 ? half[1] : -half[1], corner & 1 ? half[2] : -half[2]};
        lower_to_point(triangle, p, least);
        for (int axis = 0; axis < 3; ++axis) {
            if (!(p[axis] < 0)) continue;
            double q[3] = {p[0], p[1], p[2]};
            q[axis] = -p[axis];
            lower_to_segment(triangle, p, q, least);
        }
    }
    return least;
}

constexpr double STEEPEST = 1.7320508075688772;  // slope of a trilinear function of distances
constexpr int DEEPEST = 10;                      // halvings of a triangle over a grid

// Goes down from the best sample, within the triangle.
HOST_DEVICE_CALL void descend(const ObstacleTable& t, int obstacle, const double* triangle, double step, LeastPoint& least) {
    for (int trial = 0; trial < 24; ++trial) {
        double p[3], n[3], w[3], off[3], q[3];
        point_of(triangle, least.weight, p);
        distance_from(t, obstacle, p, n);
        for (int k = 0; k < 3; ++k) p[k] -= step * n[k];
        apart(p, triangle, triangle + 3, triangle + 6, w, off);
        point_of(triangle, w, q);
        const double before = least.distance;
        lower(least, distance_from(t, obstacle, q, n), w[0], w[1], w[2]);
        if (!(least.distance < before)) step *= 0.5;
    }
}

// Least distance below `bound`; without one the bound.
HOST_DEVICE_CALL LeastPoint least_to_grid(const ObstacleTable& t, int obstacle, const double* triangle, double bound) {
    const double spacing = t.size[4 * obstacle + 3];
    LeastPoint least = {bound, {1, 0, 0}};
    double stack[3 * DEEPEST + 4][9];  // weights of the corners of parts
    int level[3 * DEEPEST + 4], depth = 0;
    for (int k = 0; k < 9; ++k) stack[0][k] = k % 4 == 0;
    level[depth++] = 0;
    while (depth) {
        double part[9], corner[9], middle[3], p[3], n[3], radius = 0;
        const int own = level[--depth];
        for (int k = 0; k < 9; ++k) part[k] = stack[depth][k];
        for (int k = 0; k < 3; ++k) middle[k] = (part[k] + part[3 + k] + part[6 + k]) / 3;
        point_of(triangle, middle, p);
        for (int a = 0; a < 3; ++a) {
            point_of(triangle, part + 3 * a, corner + 3 * a);
            const double off[3] = {corner[3 * a] - p[0], corner[3 * a + 1] - p[1], corner[3 * a + 2] - p[2]};
            radius = fmax(radius, sqrt(dot3(off, off)));
        }
        const double here = distance_from(t, obstacle, p, n);
        lower(least, here, middle[0], middle[1], middle[2]);
        if (here - STEEPEST * radius >= least.distance) continue;
        if (!(radius > 0.5 * spacing) || own == DEEPEST) {
            for (int a = 0; a < 3; ++a)
                lower(least, distance_from(t, obstacle, corner + 3 * a, n), part[3 * a], part[3 * a + 1], part[3 * a + 2]);
            continue;
        }
        double half[9];
        for (int a = 0; a < 3; ++a)
            for (int k = 0; k < 3; ++k) half[3 * a + k] = (part[3 * a + k] + part[(3 * a + 3) % 9 + k]) / 2;  // of corners a, a + 1
        for (int a = 0; a < 3; ++a) {
            for (int k = 0; k < 3; ++k) {
                stack[depth][k] = part[3 * a + k];
                stack[depth][3 + k] = half[3 * a + k];
                stack[depth][6 + k] = half[(3 * a + 6) % 9 + k];
            }
            level[depth++] = own + 1;
        }
        for (int k = 0; k < 9; ++k) stack[depth][k] = half[k];
        level[depth++] = own + 1;
    }
    if (least.distance < bound) descend(t, obstacle, triangle, 0.25 * spacing, least);
    return least;
}

// The point of a triangle with the least distance from an obstacle; of a grid, if it is below `bound`.
HOST_DEVICE_CALL LeastPoint least_on_triangle(const ObstacleTable& t, int obstacle, const double* triangle, double bound) {
    const double* size = t.size + 4 * obstacle;
    LeastPoint least = {1e300, {1, 0, 0}};
    double n[3];
    switch (t.kind[obstacle]) {
        case SPHERE: least = least_to_axis(triangle, 0); least.distance -= size[0]; break;
        case CAPSULE: least = least_to_axis(triangle, size[1]); least.distance -= size[0]; break;
        case BOX: return least_to_box(t, obstacle, triangle);
        case GRID: return least_to_grid(t, obstacle, triangle, bound);
        default:
            for (int a = 0; a < 3; ++a) lower(least, distance_from(t, obstacle, triangle + 3 * a, n), a == 0, a == 1, a == 2);
    }
    return least;
}

// --- moving triangles ---------------------------------------------------------------------------------------------------------------

HOST_DEVICE void triangle_at(const double* begin, const double* end, double time, double* triangle) {
    for (int k = 0; k < 9; ++k) triangle[k] = begin[k] + time * (end[k] - begin[k]);
}

HOST_DEVICE double farthest_way(const double* begin, const double* end) {
    double most = 0;
    for (int a = 0; a < 3; ++a) {
        const double way[3] = {end[3 * a] - begin[3 * a], end[3 * a + 1] - begin[3 * a + 1], end[3 * a + 2] - begin[3 * a + 2]};
        most = fmax(most, dot3(way, way));
    }
    return sqrt(most);
}

struct NodeWay {          // of a node past an obstacle
    double begin[3], end[3];
    double distance, normal[3];          // at its begin
    double end_distance, end_normal[3];
};

HOST_DEVICE_CALL NodeWay way_of(const ObstacleTable& t, int obstacle, const double* from, const double* to) {
    NodeWay w;
    local_point(t.begin + 7 * obstacle, from, w.begin);
    local_point(t.end + 7 * obstacle, to, w.end);
    w.distance = distance_from(t, obstacle, w.begin, w.normal);
    w.end_distance = distance_from(t, obstacle, w.end, w.end_normal);
    return w;
}

// Infinite numbers and those that are none differ from themselves by something else than 0.
HOST_DEVICE bool is_finite(const NodeWay& w) {
    double sum = 0;
    for (int k = 0; k < 3; ++k) sum += w.begin[k] + w.end[k];
    return sum - sum == 0;
}

HOST_DEVICE bool plane_clears(const NodeWay* const* ways, const double* p, double distance, const double* normal, double above) {
    for (int a = 0; a < 3; ++a) {
        double low = 0, high = 0;
        for (int k = 0; k < 3; ++k) {
            low += normal[k] * (ways[a]->begin[k] - p[k]);
            high += normal[k] * (ways[a]->end[k] - p[k]);
        }
        if (!(distance + fmin(low, high) > above)) return false;
    }
    return true;
}

// True if all of a triangle on its way is certainly farther away than `above`: by a plane that touches the graph of a convex function
// at one of the corners, or by the slope of a grid's distances there. ways: of the three corners.
HOST_DEVICE bool stays_clear(const ObstacleTable& t, int obstacle, const NodeWay* const* ways, double above) {
    for (int a = 0; a < 3; ++a) {
        const NodeWay& w = *ways[a];
        if (t.kind[obstacle] != GRID) {
            if (plane_clears(ways, w.begin, w.distance, w.normal, above) || plane_clears(ways, w.end, w.end_distance, w.end_normal, above)) return true;
            continue;
        }
        double reach = 0;
        for (int b = 0; b < 3; ++b) {
            const double *p = w.begin, *x = ways[b]->begin, *y = ways[b]->end;
            const double one[3] = {x[0] - p[0], x[1] - p[1], x[2] - p[2]}, other[3] = {y[0] - p[0], y[1] - p[1], y[2] - p[2]};
            reach = fmax(reach, fmax(dot3(one, one), dot3(other, other)));
        }
        if (w.distance - STEEPEST * sqrt(reach) > above) return true;
    }
    return false;
}

// True if no point of a triangle is ever nearer to a convex shape than its corners, by more than `slack`: if the distances of the corners
// at the start and the end are those from one plane, within it. The distance function lies above that plane, and is convex.
HOST_DEVICE bool corners_decide(const ObstacleTable& t, int obstacle, const NodeWay* const* ways, double slack) {
    if (t.kind[obstacle] == GRID) return false;
    for (int a = 0; a < 3; ++a) {
        const NodeWay& by = *ways[a];
        double most = 0;
        for (int b = 0; b < 3; ++b) {
            double begin = ways[b]->distance - by.distance, end = ways[b]->end_distance - by.distance;
            for (int k = 0; k < 3; ++k) {
                begin -= by.normal[k] * (ways[b]->begin[k] - by.begin[k]);
                end -= by.normal[k] * (ways[b]->end[k] - by.begin[k]);
            }
            most = fmax(most, fmax(begin, end));
        }
        if (most <= slack) return true;
    }
    return false;
}

constexpr int MOST_ADVANCES = 200;

// First time in [0, 1] at which a triangle that is farther away than `inflate` comes so near, to `slack`; NEVER. Each advance ends where
// a plane that touches the distance function from below is reached: never beyond the entry. Of a grid it is what its slope allows, but at
// least a 16th of its spacing. least: the point then.
HOST_DEVICE_CALL double entry_of_triangle(const ObstacleTable& t, int obstacle, const double* begin, const double* end, double inflate, double slack,
                                     LeastPoint& least) {
    const double most = farthest_way(begin, end), spacing = t.size[4 * obstacle + 3];
    const bool grid = t.kind[obstacle] == GRID;
    double time = 0;
    for (int trial = 0; trial < MOST_ADVANCES || grid; ++trial) {
        double triangle[9], p[3], n[3];
        triangle_at(begin, end, time, triangle);
        const double left = (1 - time) * most * (grid ? STEEPEST : 1);
        least = least_on_triangle(t, obstacle, triangle, inflate + left + slack);
        if (least.distance - inflate <= slack) return time;
        if (least.distance - inflate > left) return NEVER;
        if (grid) {
            time += fmax((least.distance - inflate) / STEEPEST, spacing / 16) / most;
            if (!(time <= 1)) return NEVER;
            continue;
        }
        point_of(triangle, least.weight, p);
        distance_from(t, obstacle, p, n);
        double next = NEVER;
        for (int a = 0; a < 3; ++a) {
            double above = least.distance - inflate, rate = 0;
            for (int k = 0; k < 3; ++k) {
                above += n[k] * (triangle[3 * a + k] - p[k]);
                rate += n[k] * (end[3 * a + k] - begin[3 * a + k]);
            }
            if (rate < 0) next = fmin(next, time + above / -rate);
        }
        const double certain = time + (least.distance - inflate) / most;
        time = fmax(next, certain);
        if (!(time <= 1)) return NEVER;
    }
    return time;
}

constexpr double SHALLOW = 0.1;  // thicknesses: what is deeper than the corners by less is theirs

struct FaceTouch {         // where a triangle may touch an obstacle in a step, between its corners
    int obstacle;          // -1: it does not
    double entry;          // part of the step at which it comes nearer than the thickness; NEVER
    double distance;       // at the start of the step
    double time;           // at which the plane stands
    double weight[3];      // of the point nearest to the obstacle then
    double held[3];        // of the point that is to stay in front of the plane
};

HOST_DEVICE bool comes_before(const FaceTouch& a, const FaceTouch& b) {
    if (b.obstacle < 0) return a.obstacle >= 0;
    return a.obstacle >= 0 && (a.entry < b.entry || (a.entry == b.entry && a.distance < b.distance));
}

// Where a triangle first comes nearer than the thickness, or is nearer than twice that, if its corners are not as near. ways: of them.
HOST_DEVICE FaceTouch face_touch(const ObstacleTable& t, int obstacle, const NodeWay* const* ways, double thickness) {
    FaceTouch touch = {-1, NEVER, 0, 0, {}, {}};
    if (t.kind[obstacle] == PLANE || stays_clear(t, obstacle, ways, 2 * thickness)) return touch;
    if (corners_decide(t, obstacle, ways, SHALLOW * thickness)) return touch;
    double begin[9], end[9], corners = 1e300, n[3];
    for (int a = 0; a < 3; ++a) {
        for (int k = 0; k < 3; ++k) {
            begin[3 * a + k] = ways[a]->begin[k];
            end[3 * a + k] = ways[a]->end[k];
        }
        corners = fmin(corners, ways[a]->distance);
    }
    const double most = farthest_way(begin, end);
    LeastPoint least = least_on_triangle(t, obstacle, begin, 2 * thickness + STEEPEST * most), then;
    const bool own = least.distance < corners - SHALLOW * thickness;
    touch.distance = least.distance;
    if (least.distance <= thickness) {
        if (!own) return touch;
        double p[3], way[3];
        point_of(begin, least.weight, p);
        point_of(end, least.weight, way);
        distance_from(t, obstacle, p, n);
        for (int k = 0; k < 3; ++k) way[k] -= p[k];
        touch.entry = dot3(n, way) < 0 ? 0 : NEVER;
    } else {
        const double time = most > 0 ? entry_of_triangle(t, obstacle, begin, end, thickness, 1e-3 * thickness, then) : NEVER;
        if (time <= 1) {
            double there[9];
            triangle_at(begin, end, time, there);
            for (int a = 0; a < 3; ++a)
                if (distance_from(t, obstacle, there + 3 * a, n) <= then.distance + SHALLOW * thickness) return touch;
            least = then;
            touch.entry = touch.time = time;
        } else if (!own || !(least.distance < 2 * thickness)) {
            return touch;
        }
    }
    touch.obstacle = obstacle;
    for (int a = 0; a < 3; ++a) touch.weight[a] = touch.held[a] = least.weight[a];
    return touch;
}

// Where a point of a triangle that carried force touches the obstacle now: there, as long as it is nearly the nearest one, since along a
// line of contact the nearest one may change with every step. weight: of the point.
HOST_DEVICE FaceTouch face_stays(const ObstacleTable& t, int obstacle, const NodeWay* const* ways, double thickness, const double* weight) {
    FaceTouch touch = {-1, NEVER, 0, 0, {}, {}};
    double triangle[9], end[9], p[3], way[3], n[3];
    for (int a = 0; a < 3; ++a)
        for (int k = 0; k < 3; ++k) {
            triangle[3 * a + k] = ways[a]->begin[k];
            end[3 * a + k] = ways[a]->end[k];
        }
    point_of(triangle, weight, p);
    touch.distance = distance_from(t, obstacle, p, n);
    if (!(touch.distance < 2 * thickness)) return touch;
    if (touch.distance > least_on_triangle(t, obstacle, triangle, touch.distance).distance + SHALLOW * thickness) return touch;
    point_of(end, weight, way);
    for (int k = 0; k < 3; ++k) way[k] -= p[k];
    if (touch.distance <= thickness && dot3(n, way) < 0) touch.entry = 0;
    touch.obstacle = obstacle;
    for (int a = 0; a < 3; ++a) touch.weight[a] = touch.held[a] = weight[a];
    return touch;
}

// Where a triangle that was outside is taken through the surface of an obstacle, before its corners; obstacle -1: it is not. The plane
// stands where it came nearer than the thickness, or at its start, and separates both there; what passes is held. ways: of its corners.
// time: of the passage.
HOST_DEVICE FaceTouch face_passage(const ObstacleTable& t, int obstacle, const NodeWay* const* ways, double thickness, double through, double* time) {
    FaceTouch touch = {-1, NEVER, 0, 0, {}, {}};
    if (t.kind[obstacle] == PLANE || stays_clear(t, obstacle, ways, through)) return touch;
    if (corners_decide(t, obstacle, ways, 1e-6 * thickness)) return touch;
    double begin[9], end[9], there[9], n[3];
    for (int a = 0; a < 3; ++a)
        for (int k = 0; k < 3; ++k) {
            begin[3 * a + k] = ways[a]->begin[k];
            end[3 * a + k] = ways[a]->end[k];
        }
    const double most = farthest_way(begin, end);
    if (!(most > 0)) return touch;
    LeastPoint least = least_on_triangle(t, obstacle, begin, through + STEEPEST * most), passed;
    touch.distance = least.distance;
    if (!(least.distance > 0)) return touch;
    if (least.distance <= through) {
        double p[3], way[3];
        point_of(begin, least.weight, p);
        point_of(end, least.weight, way);
        distance_from(t, obstacle, p, n);
        for (int k = 0; k < 3; ++k) way[k] -= p[k];
        if (!(dot3(n, way) < -least.distance)) return touch;
        *time = 0;
        passed = least;
    } else {
        *time = entry_of_triangle(t, obstacle, begin, end, 0, through, passed);
        if (*time > 1) return touch;
    }
    triangle_at(begin, end, *time, there);
    for (int a = 0; a < 3; ++a)
        if (distance_from(t, obstacle, there + 3 * a, n) <= passed.distance + 1e-6 * thickness) return touch;
    touch.obstacle = obstacle;
    touch.entry = touch.time = 0;
    if (least.distance > thickness) {
        const double near = entry_of_triangle(t, obstacle, begin, end, thickness, 1e-3 * thickness, least);
        touch.entry = touch.time = near <= 1 ? near : 0;
    }
    for (int a = 0; a < 3; ++a) {
        touch.weight[a] = least.weight[a];
        touch.held[a] = passed.weight[a];
    }
    return touch;
}
