// SPDX-License-Identifier: MIT
// Rows of triangles against obstacles on a GPU: what nodes have of them, in sums of fixed order; included by device_contact.cuh.
//
// A row joins three nodes of one body, between which A has blocks, so that its stiffness goes into values of A as that of nodes does.
#pragma once

// f(row) of the rows of a body against obstacles that are not empty, those of a thread of the thread block
template <class F> __device__ __forceinline__ void each_own_row(const ContactArguments& c, int body, F f) {
    auto each = [&](int first, int last) {
        for (int r = first + threadIdx.x; r < last; r += CONTACT_THREADS)
            if (used(c, r)) f(r);
    };
    each(c.body_start[body], c.body_start[body + 1]);
    if (FACES) each(c.faces.start[body], c.faces.start[body + 1]);
}

__device__ __forceinline__ bool is_face(const ContactArguments& c, int r) {
    return FACES && r >= c.faces.start[0] && r < c.faces.start[c.count];
}

// Whether a node may have rows of triangles in this step: those of its body are in use.
__device__ __forceinline__ bool has_faces(const ContactArguments& c, const SurfaceNode& n, int body) {
    return FACES && n.pair >= 0 && c.faces.rows[body] > 0;
}

// f(row, corner, entry) of the rows of triangles at a node
template <class F> __device__ __forceinline__ void each_face_row(const ContactArguments& c, int node, F f) {
    for (int e = c.faces.entry_start[node]; e < c.faces.entry_start[node + 1]; ++e) {
        const int entry = c.faces.entry[e], r = c.faces.start[0] + entry / CORNERS;
        if (used(c, r)) f(r, entry % CORNERS, e);
    }
}
__device__ __forceinline__ FaceRow& face_row(const ContactArguments& c, int r) { return c.faces.row[r - c.faces.start[0]]; }

// to += R^T sum_rows weight v(row)
template <class Of> __device__ __forceinline__ void add_faces(const ContactArguments& c, const SurfaceNode& n, double* to, Of of) {
    double sum[3] = {0, 0, 0}, out[3];
    each_face_row(c, n.node, [&](int r, int corner, int) {
        const double *v = of(face_row(c, r)), weight = c.faces.weight[CORNERS * r + corner];
        for (int k = 0; k < 3; ++k) sum[k] += weight * v[k];
    });
    n.to_material(sum, out);
    for (int k = 0; k < 3; ++k) to[k] += out[k];
}
__device__ __forceinline__ void add_face_impulses(const ContactArguments& c, const SurfaceNode& n, double* to) {
    add_faces(c, n, to, [](const FaceRow& row) { return row.impulse; });
}
__device__ __forceinline__ void add_face_pulls(const ContactArguments& c, const SurfaceNode& n, double* to) {
    add_faces(c, n, to, [](const FaceRow& row) { return row.pull; });
}

// block += weight R^T S R_j, S by its upper triangle
template <class Block>
__device__ __forceinline__ void add_turned(const SurfaceNode& n, const double* s, const local* there, double weight, Block* block) {
    const double S[9] = {s[0], s[1], s[2], s[1], s[3], s[4], s[2], s[4], s[5]};
    for (int j = 0; j < 3; ++j) {
        double column[3], out[3];
        for (int m = 0; m < 3; ++m)
            column[m] = S[3 * m] * (double)there[j] + S[3 * m + 1] * (double)there[3 + j] + S[3 * m + 2] * (double)there[6 + j];
        n.to_material(column, out);
        for (int m = 0; m < 3; ++m) block[3 * m + j] += (Block)(weight * out[m]);
    }
}

// Adds the stiffness s of a row to the node's own block, and, by links, to those between it and the other corners.
__device__ __forceinline__ void add_face_stiffness(const ContactArguments& c, const SurfaceNode& n, int r, int corner, int e, const double* s,
                                                   double* own, real* blocks, const int* place) {
    if (s[0] == 0 && s[3] == 0 && s[5] == 0) return;
    const double weight = c.faces.weight[CORNERS * r + corner];
    if (weight == 0) return;
    add_turned(n, s, c.rotation + 9ll * n.node, weight * weight, own);
    for (int m = 0; m < 2; ++m) {
        const int next = (corner + 1 + m) % 3, node = c.faces.node[3 * (r - c.faces.start[0]) + next], link = c.faces.entry_link[2 * e + m];
        const double other = c.faces.weight[CORNERS * r + next];
        if (link < 0 || other == 0 || c.free[node] == 0) continue;
        add_turned(n, s, c.rotation + 9ll * node, weight * other, blocks + 9ll * (place ? place[link] : link));
    }
}

// Writes the blocks between a node and its neighbours on the surface to values, from an array of links.
__device__ __forceinline__ void give_links(const ContactArguments& c, const SurfaceNode& n, const real* from) {
    for (int link = c.faces.link_start[n.node]; link < c.faces.link_start[n.node + 1]; ++link)
        for (int k = 0; k < 9; ++k) c.values[9ll * c.faces.link_place[link] + k] = from[9ll * link + k];
}

// The stiffness of rows as evaluated: what nodes share is added to values, the rest to S.
__device__ void add_face_blocks(const ContactArguments& c, const SurfaceNode& n, double* S) {
    give_links(c, n, c.faces.base);
    each_face_row(c, n.node, [&](int r, int corner, int e) {
        add_face_stiffness(c, n, r, corner, e, face_row(c, r).stiffness, S, c.values, c.faces.link_place);
    });
}

// Keeps the blocks between a node and its neighbours without contact.
__device__ void keep_links(const ContactArguments& c, const SurfaceNode& n) {
    for (int link = c.faces.link_start[n.node]; link < c.faces.link_start[n.node + 1]; ++link)
        for (int k = 0; k < 9; ++k) {
            const real own = c.values[9ll * c.faces.link_place[link] + k];
            c.faces.base[9ll * link + k] = own;
            c.faces.known[9ll * link + k] = own;
        }
}

// The stiffness of rows that carried force in the last step, as a factor is to know them: added to S and to `known` links, which are kept.
__device__ void add_known_faces(const ContactArguments& c, const SurfaceNode& n, double* S) {
    each_face_row(c, n.node, [&](int r, int corner, int e) {
        if (!(c.force[r] > 0)) return;
        double s[6];
        const ContactForce f = lasting_contact(c.friction[r], c.force[r], c.traction + 3 * r);
        contact_stiffness(row_at(c, r), f, f.traction, c.dx_dv * c.force_coefficient, s);
        add_face_stiffness(c, n, r, corner, e, s, S, c.faces.known, nullptr);
    });
}

// Place of a row's point at the start of the step.
__device__ __forceinline__ void place_on_face(const ContactArguments& c, int r, double* x) {
    const int* node = c.faces.node + 3 * (r - c.faces.start[0]);
    for (int k = 0; k < 3; ++k) {
        x[k] = 0;
        for (int a = 0; a < 3; ++a) x[k] += c.faces.weight[CORNERS * r + a] * (double)c.x[3ll * node[a] + k];
    }
}
