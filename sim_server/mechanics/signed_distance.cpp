// SPDX-License-Identifier: MIT
// Signed distances of points from a closed surface, by a tree of boxes around its triangles (signed_distance.py).
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numeric>
#include <vector>

namespace {

constexpr int LEAF = 4;  // triangles of a leaf, at most

struct Vec {
    double x, y, z;
};
Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
Vec operator*(double s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
double dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

// From the nearest point of a triangle to p. feature: where that is: corners 0 to 2, edges 3 (bc), 4 (ca), 5 (ab), face 6.
// Ericson, Real-Time Collision Detection, section 5.1.5.
Vec from_triangle(Vec p, const Vec* t, int* feature) {
    const Vec a = t[0], ab = t[1] - a, ac = t[2] - a, ap = p - a, bp = p - t[1], cp = p - t[2];
    const double d1 = dot(ab, ap), d2 = dot(ac, ap), d3 = dot(ab, bp), d4 = dot(ac, bp), d5 = dot(ab, cp), d6 = dot(ac, cp);
    if (d1 <= 0 && d2 <= 0) return *feature = 0, ap;
    if (d3 >= 0 && d4 <= d3) return *feature = 1, bp;
    if (d6 >= 0 && d5 <= d6) return *feature = 2, cp;
    const double va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, vc = d1 * d4 - d3 * d2;
    if (vc <= 0 && d1 >= 0 && d3 <= 0) return *feature = 5, ap - d1 / (d1 - d3) * ab;
    if (vb <= 0 && d2 >= 0 && d6 <= 0) return *feature = 4, ap - d2 / (d2 - d6) * ac;
    if (va <= 0 && d4 >= d3 && d5 >= d6) return *feature = 3, bp - (d4 - d3) / (d4 - d3 + d5 - d6) * (t[2] - t[1]);
    *feature = 6;
    return ap - vb / (va + vb + vc) * ab - vc / (va + vb + vc) * ac;
}

struct Box {
    double low[3], high[3];
    int first, count;  // triangles of a leaf; count 0: the children are `first` and first + 1
};

struct Tree {
    const Vec* corners;
    std::vector<int> order;
    std::vector<Box> boxes;

    Tree(const Vec* corners, int triangles) : corners(corners), order(triangles) {
        std::iota(order.begin(), order.end(), 0);
        boxes.reserve(2 * triangles);
        boxes.push_back({});
        split(0, 0, triangles);
    }

    double entry(int triangle, int corner, int axis) const { return (&corners[3 * triangle + corner].x)[axis]; }
    double middle(int triangle, int axis) const {
        return entry(triangle, 0, axis) + entry(triangle, 1, axis) + entry(triangle, 2, axis);
    }

    void split(int box, int first, int count) {
        Box b{{}, {}, first, count};
        int widest = 0;
        for (int k = 0; k < 3; ++k) {
            b.low[k] = std::numeric_limits<double>::infinity();
            b.high[k] = -b.low[k];
            for (int i = first; i < first + count; ++i)
                for (int c = 0; c < 3; ++c) {
                    b.low[k] = std::min(b.low[k], entry(order[i], c, k));
                    b.high[k] = std::max(b.high[k], entry(order[i], c, k));
                }
            if (b.high[k] - b.low[k] > b.high[widest] - b.low[widest]) widest = k;
        }
        if (count <= LEAF) {
            boxes[box] = b;
            return;
        }
        const auto begin = order.begin() + first;
        std::nth_element(begin, begin + count / 2, begin + count, [&](int i, int j) {
            const double a = middle(i, widest), c = middle(j, widest);
            return a < c || (a == c && i < j);
        });
        b.first = (int)boxes.size();
        b.count = 0;
        boxes[box] = b;
        boxes.push_back({});
        boxes.push_back({});
        split(b.first, first, count / 2);
        split(b.first + 1, first + count / 2, count - count / 2);
    }

    // Square of the distance of a box.
    double away(const Box& b, Vec p) const {
        const double x[3] = {p.x, p.y, p.z};
        double square = 0;
        for (int k = 0; k < 3; ++k) {
            const double out = std::max({b.low[k] - x[k], x[k] - b.high[k], 0.0});
            square += out * out;
        }
        return square;
    }

    // Square of the distance of the nearest triangle. triangle: in: one to begin with, out: the nearest.
    double nearest(Vec p, int* triangle, int* feature, Vec* offset) const {
        *offset = from_triangle(p, corners + 3 * *triangle, feature);
        double best = dot(*offset, *offset);
        int stack[128], depth = 0;
        stack[depth++] = 0;
        while (depth) {
            const Box& b = boxes[stack[--depth]];
            if (away(b, p) >= best) continue;
            for (int i = b.first; i < b.first + b.count; ++i) {
                int where;
                const Vec off = from_triangle(p, corners + 3 * order[i], &where);
                if (dot(off, off) < best) {
                    best = dot(off, off);
                    *triangle = order[i];
                    *feature = where;
                    *offset = off;
                }
            }
            if (b.count) continue;
            const bool swap = away(boxes[b.first], p) < away(boxes[b.first + 1], p);  // the nearer one first
            stack[depth++] = b.first + swap;
            stack[depth++] = b.first + !swap;
        }
        return best;
    }
};

}  // namespace

// corners: (triangles, 3, 3). normals: (triangles, 7, 3), of each feature. points: (n, 3), neighbours one after another. out: (n,)
extern "C" void wf_signed_distances(int triangles, const double* corners, const double* normals, int n, const double* points,
                                    double* out) {
    const Tree tree(reinterpret_cast<const Vec*>(corners), triangles);
    const Vec *p = reinterpret_cast<const Vec*>(points), *normal = reinterpret_cast<const Vec*>(normals);
    int triangle = 0, feature = 0;
    for (int i = 0; i < n; ++i) {
        Vec offset;
        const double distance = std::sqrt(tree.nearest(p[i], &triangle, &feature, &offset));
        out[i] = dot(offset, normal[7 * triangle + feature]) < 0 ? -distance : distance;
    }
}
