// SPDX-License-Identifier: MIT
// Nodes that may move along some directions only (mechanics/rollers.py): what they change in b, in frames and in nodes' own blocks.
#define WIDE
#include "mat3.cuh"

struct KeepForce {
    int n;               // nodes
    const real* allowed; // (n, 6) upper triangle of S, the projection on the directions in which a node may move
    own<real> b;         // (n, 3) in, out: right-hand side, world frame: S b [N s]
};

INLINE mat3 projection_of(const real* allowed, index i) {
    return symmetric(row_at<6>(allowed, i, 0), row_at<6>(allowed, i, 1), row_at<6>(allowed, i, 2), row_at<6>(allowed, i, 3),
                     row_at<6>(allowed, i, 4), row_at<6>(allowed, i, 5));
}

KERNEL(keep_force, KeepForce) { store3(p.b, i, mul(projection_of(p.allowed, i), load3(p.b, i))); }

struct KeepFrame {
    int n;             // nodes
    const real* axis;  // (n, 3) unit vector about which alone the frame of a node turns; 0: it turns as it likes
    own<local> mean;   // (n, 10) in, out: upper triangle of the sum of q q^T, q the elements' rotations; out: q q^T of the frame
};

// Of the rotations (c, s a) about the axis a, the one nearest to the mean: the largest eigenvector (c, s) of the 2 x 2 part of the sum.
KERNEL(keep_frame, KeepFrame) {
    local_vec3 a = as<local_number>(load3(p.axis, i));
    local_number m[10];
    for (int k = 0; k < 10; ++k) m[k] = row_at<10>(p.mean, i, k);
    local_number across = a.x * m[1] + a.y * m[2] + a.z * m[3];
    local_vec3 along = {m[4] * a.x + m[5] * a.y + m[6] * a.z, m[5] * a.x + m[7] * a.y + m[8] * a.z, m[6] * a.x + m[8] * a.y + m[9] * a.z};
    local_number half = (m[0] - dot(a, along)) / 2, size = sqrt(half * half + across * across), one = local_number{} + 1;
    local_number inverse = 1 / (size > 0 ? size : one), c2 = (1 + half * inverse) / 2, s2 = (1 - half * inverse) / 2, cs = across * inverse / 2;
    c2 = size > 0 ? c2 : one;
    s2 = size > 0 ? s2 : local_number{};
    const local_number kept[10] = {c2,           cs * a.x,     cs * a.y,     cs * a.z,     s2 * a.x * a.x,
                                   s2 * a.x * a.y, s2 * a.x * a.z, s2 * a.y * a.y, s2 * a.y * a.z, s2 * a.z * a.z};
    auto turns = dot(a, a) > 0;
    for (int k = 0; k < 10; ++k) row_put<10>(p.mean, i, k, turns ? kept[k] : m[k]);
}

struct KeepBlock {
    int n;               // nodes
    const real* allowed; // (n, 6)
    const real* axis;    // (n, 3) 0: nothing keeps the node from any direction
    own<local> block;    // (n, 6) in, out: upper triangle of the node's own block, world frame: S K S + (tr K / 3) (1 - S) [kg]
};

KERNEL(keep_block, KeepBlock) {
    local_mat3 S = as<local_number>(projection_of(p.allowed, i));
    local_number k[6];
    for (int m = 0; m < 6; ++m) k[m] = row_at<6>(p.block, i, m);
    local_mat3 A = mul(S, mul(symmetric(k[0], k[1], k[2], k[3], k[4], k[5]), S));
    const local_number t = (k[0] + k[3] + k[5]) / 3;
    const local_number kept[6] = {A.m[0] + t * (1 - S.m[0]), (A.m[1] + A.m[3]) / 2 - t * S.m[1], (A.m[2] + A.m[6]) / 2 - t * S.m[2],
                                  A.m[4] + t * (1 - S.m[4]), (A.m[5] + A.m[7]) / 2 - t * S.m[5], A.m[8] + t * (1 - S.m[8])};
    local_vec3 a = as<local_number>(load3(p.axis, i));
    auto kept_here = dot(a, a) > 0;
    for (int m = 0; m < 6; ++m) row_put<6>(p.block, i, m, kept_here ? kept[m] : k[m]);
}
