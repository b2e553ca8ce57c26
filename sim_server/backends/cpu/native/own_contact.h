// SPDX-License-Identifier: MIT
// Which vertices and edges of a body may touch the body itself in a step, so that a body that comes nowhere near itself is not searched.
//
// In some steps, the reference, the distance of each vertex and edge from what it may touch of its own body is measured, up to a range.
// Rigid motions keep distances, so later ones are smaller by at most how far both sides have moved but for such a motion:
//     distance >= measured - moved_vertex - moved_most,   moved = |x - Q x_ref - t| + |s - t' - w x (x - centre)|
// with any rotation Q and any t, t', w; s is the displacement in the step (under x + time (t' + w x (x - centre)) no distance shrinks).
#pragma once
#include <algorithm>
#include <cmath>

#include "loop.h"
#include "own_surface.cuh"

constexpr double SMALL_TURN = 1e-4;  // rad: a rotation that is left

struct OwnSearch {
    typedef SurfaceMotion<double, double> Motion;
    const Contact& c;
    const SurfaceTables& tables;
    const EdgeTables& edges;
    const Motion& motion;
    const OwnContact& own;

    bool exists() const { return own.near.start; }

    template <class F> void each_node(int body, F f) const {
        for (int k = own.start[body]; k < own.start[body + 1]; ++k) f(own.node[k], k);
    }
    template <class F> void each_site(int body, F f) const {
        for (int site = sites_before(tables, body); site < sites_before(tables, body + 1); ++site) f(site);
    }
    template <class F> void each_edge(int body, F f) const {
        for (int edge = (c.edge_start[body] - c.edge_start[0]) / 2; edge < (c.edge_start[body + 1] - c.edge_start[0]) / 2; ++edge) f(edge);
    }

    // --- how far nodes have moved -----------------------------------------------------------------------------------------------------

    struct Fit {  // of vectors s at places r by t + w x (r - centre)
        Vector3 centre, t, w;
    };
    // r(k), s(k): of the k-th node of the body, counted from those of all
    template <class R, class S> Fit fit_rigid(int body, R r, S s) const {
        const double n = own.start[body + 1] - own.start[body];
        Vector3 centre = {}, t = {}, squares = {}, products = {}, turn = {};
        each_node(body, [&](int node, int k) {
            centre = centre + (1 / n) * r(node, k);
            t = t + (1 / n) * s(node, k);
        });
        each_node(body, [&](int node, int k) {
            const Vector3 a = r(node, k) - centre;
            squares = squares + Vector3{a.x * a.x, a.y * a.y, a.z * a.z};
            products = products + Vector3{a.y * a.z, a.z * a.x, a.x * a.y};
            turn = turn + cross3(a, s(node, k));
        });
        return {centre, t, spin_of(squares, products, turn)};
    }
    Vector3 place(int node) const { return at3(motion.x, node); }
    Vector3 way(int node) const {
        double s[3];
        displacement_of(motion, node, s);
        return {s[0], s[1], s[2]};
    }

    // Adds the displacements of this motion to what nodes have moved since the reference.
    void add_ways(int body) const {
        OwnReference& ref = own.body[body];
        const Fit rigid = fit_rigid(body, [&](int node, int) { return place(node); }, [&](int node, int) { return way(node); });
        ref.most = ref.most_in_step = 0;
        each_node(body, [&](int node, int) {
            const Vector3 rest = way(node) - rigid.t - cross3(rigid.w, place(node) - rigid.centre);
            const double moved = std::sqrt(dot3(rest, rest));
            own.moved[node] = own.strain[node] + moved;
            ref.most = larger_of(ref.most, own.moved[node]);
            ref.most_in_step = larger_of(ref.most_in_step, moved);
        });
    }
    static double larger_of(double most, double value) { return value <= most || std::isnan(most) ? most : value; }  // NaN stays

    // Follows the rotation since the reference, and sets what nodes have moved up to the start of the step.
    void follow(int body) const {
        OwnReference& ref = own.body[body];
        double* Q = ref.rotation;
        auto turned = [&](int, int k) {
            double v[3];
            rotated(Q, own.reference + 3 * (int64_t)k, v);
            return Vector3{v[0], v[1], v[2]};
        };
        auto off_reference = [&](int node, int k) { return place(node) - turned(node, k); };
        Fit rest = fit_rigid(body, turned, off_reference);
        for (int k = 0; k < 2; ++k) {
            const double angle = std::sqrt(dot3(rest.w, rest.w));
            if (!(angle > SMALL_TURN)) break;
            const Vector3 axis = (1 / angle) * rest.w;
            for (int column = 0; column < 3; ++column) {
                const Vector3 a = {Q[column], Q[3 + column], Q[6 + column]}, across = cross3(axis, a);
                const Vector3 b = std::cos(angle) * a + std::sin(angle) * across + (1 - std::cos(angle)) * dot3(axis, a) * axis;
                Q[column] = b.x; Q[3 + column] = b.y; Q[6 + column] = b.z;
            }
            make_orthonormal(Q);
            rest = fit_rigid(body, turned, off_reference);
        }
        each_node(body, [&](int node, int k) {
            const Vector3 off = off_reference(node, k) - rest.t;
            own.strain[node] = std::sqrt(dot3(off, off));
        });
    }
    static void make_orthonormal(double* Q) {  // rows, by Gram and Schmidt
        Vector3 a = at3(Q, 0), b = at3(Q, 1);
        a = (1 / std::sqrt(dot3(a, a))) * a;
        b = b - dot3(a, b) * a;
        b = (1 / std::sqrt(dot3(b, b))) * b;
        put3(Q, 0, a);
        put3(Q, 1, b);
        put3(Q, 2, cross3(a, b));
    }

    // --- what may touch ---------------------------------------------------------------------------------------------------------------

    // margin: thicknesses within which a vertex is looked at: 2 before a solve, 1 after it
    bool may_touch(double clear, double moved, int body, double margin) const {
        return !(own.body[body].range > 0 && clear - moved - own.body[body].most > margin * c.body_thickness[body]);
    }
    bool site_may_touch(int site, int body, double margin) const {
        return may_touch(own.clear[site], own.moved[node_of_site(tables, site)], body, margin);
    }
    bool edge_may_touch(int edge, int body, double margin) const {
        const int32_t* node = c.edge + 2 * edge;
        return may_touch(own.edge_clear[edge], std::fmax(own.moved[node[0]], own.moved[node[1]]), body, margin);
    }
    bool any_may_touch(int body, double margin) const {
        const OwnReference& ref = own.body[body];
        if (ref.range > 0 && ref.least - 2 * ref.most > margin * c.body_thickness[body]) return false;
        bool any = false;
        each_site(body, [&](int site) { any = any || site_may_touch(site, body, margin); });
        each_edge(body, [&](int edge) { any = any || edge_may_touch(edge, body, margin); });
        return any;
    }

    // After it, of what the step may take through the surface.
    bool may_pass(double apart, double moved_in_step, int body) const {
        return !(apart - moved_in_step - own.body[body].most_in_step > THROUGH * c.body_thickness[body]);
    }
    bool site_may_pass(int site, int body) const {
        const int node = node_of_site(tables, site);
        return may_pass(own.apart[site], own.moved[node] - own.strain[node], body) && site_may_touch(site, body, 1);
    }
    bool edge_may_pass(int edge, int body) const {
        const int32_t* node = c.edge + 2 * edge;
        const double moved = std::fmax(own.moved[node[0]] - own.strain[node[0]], own.moved[node[1]] - own.strain[node[1]]);
        return may_pass(own.edges_apart[edge], moved, body) && edge_may_touch(edge, body, 1);
    }
    bool any_may_pass(int body) const {
        if (!any_may_touch(body, 1)) return false;
        bool any = false;
        each_site(body, [&](int site) { any = any || site_may_pass(site, body); });
        each_edge(body, [&](int edge) { any = any || edge_may_pass(edge, body); });
        return any;
    }

    // Before the solve: returns whether the body may touch itself, or has to be measured, which needs its tree.
    bool begin(int body) const {
        OwnReference& ref = own.body[body];
        if (ref.range > 0) follow(body);
        else each_node(body, [&](int node, int) { own.strain[node] = 0; });
        add_ways(body);
        each_site(body, [&](int site) { own.apart[site] = 2 * c.body_thickness[body]; });
        each_edge(body, [&](int edge) { own.edges_apart[edge] = 2 * c.body_thickness[body]; });
        return wants_reference(body) || any_may_touch(body, 2);
    }
    // True if what is nowhere near cannot be told by the reference, but could be by a new one.
    bool wants_reference(int body) const {
        const OwnReference& ref = own.body[body];
        const double margin = 2 * c.body_thickness[body], range = margin + c.edge_length[body];
        return !(ref.range > 0 && ref.range - 2 * ref.most > margin) && range - 2 * ref.most_in_step > margin;
    }
    // Makes the start of this step the reference. The tree is fitted.
    void measure(int body) const {
        OwnReference& ref = own.body[body];
        ref.range = 2 * c.body_thickness[body] + c.edge_length[body];
        for (int k = 0; k < 9; ++k) ref.rotation[k] = k % 4 == 0;
        each_node(body, [&](int node, int k) {
            put3(own.reference, k, place(node));
            own.strain[node] = 0;
        });
        ref.least = ref.range;
        each_site(body, [&](int site) {
            own.clear[site] = room_of_vertex(body, node_of_site(tables, site), ref.range);
            ref.least = std::fmin(ref.least, own.clear[site]);
        });
        each_edge(body, [&](int edge) {
            own.edge_clear[edge] = room_of_edge(body, edge, ref.range);
            ref.least = std::fmin(ref.least, own.edge_clear[edge]);
        });
        add_ways(body);
    }
    Box box_around(int node, double margin) const {
        Box box = empty_box();
        include(box, motion.x + 3 * (int64_t)node, margin);
        return box;
    }
    double room_of_vertex(int body, int node, double range) const {
        double least = range, weight[3], off[3];
        each_own_triangle(tables, body, box_around(node, range), [&](int triangle) {
            const int* t = c.triangle + 3 * triangle;
            if (is_nearby_triangle(own.near, node, t)) return;
            const double* x = motion.x;
            least = std::fmin(least, apart(x + 3 * (int64_t)node, x + 3 * (int64_t)t[0], x + 3 * (int64_t)t[1], x + 3 * (int64_t)t[2], weight, off));
        });
        return least;
    }
    double room_of_edge(int body, int edge, double range) const {
        const int32_t* node = c.edge + 2 * edge;
        const double* x = motion.x;
        double least = range;
        each_own_triangle(tables, body, joined(box_around(node[0], range), box_around(node[1], range)), [&](int triangle) {
            for (int a = 0; a < 3; ++a) {
                const int facing = c.triangle_edge[3 * triangle + a];
                const int32_t* other = c.edge + 2 * (int64_t)facing;
                if (facing < 0 || are_nearby_edges(own.near, node, other)) continue;
                double s, t;
                least = std::fmin(least, nearest_on_segments(x + 3 * (int64_t)node[0], x + 3 * (int64_t)node[1], x + 3 * (int64_t)other[0],
                                                             x + 3 * (int64_t)other[1], &s, &t));
            }
        });
        return least;
    }
};
