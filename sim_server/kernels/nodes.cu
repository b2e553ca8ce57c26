// SPDX-License-Identifier: MIT
// What every step does node by node, whatever its effects.
#define WIDE
#include "polar.cuh"
#include "together.cuh"

struct Start {
    int n;               // nodes
    const real* mass;    // (n,) [kg]
    own<real> diagonal;  // (n, 1) out: what goes onto the diagonal of A [kg]
    own<real> b;         // (n, 3) out: right-hand side, world frame [N s]
    own<local> block;    // (n, 6) out: upper triangle of the node's own block of A, world frame [kg]
    own<local> mean;     // (n, 10) out: upper triangle of the sum of q q^T, q the elements' rotations
};

// Lumped mass and nothing else; the effects then add to all of them.
KERNEL(start, Start) {
    row_put<1>(p.diagonal, i, 0, at(p.mass, i));
    store3(p.b, i, vec3{});
    for (int k = 0; k < 6; ++k) row_put<6>(p.block, i, k, local_number{});
    for (int k = 0; k < 10; ++k) row_put<10>(p.mean, i, k, local_number{});
}

struct Turn {
    int n;               // nodes
    const real* free;    // (n,) 1, or 0 at fixed nodes
    const real* warped;  // (n,) 1, or 0 where the rotation stays the identity
    const int* place;    // (n,) of the node's own block in the full pattern
    own<local> mean;     // (n, 10) upper triangle of the sum of q q^T
    own<real> b;         // (n, 3) world frame [N s]
    own<real> diagonal;  // (n, 1) [kg]
    own<local> block;    // (n, 6) upper triangle, world frame [kg]
    const real* dv;      // (n, 3) solution of the last step, world frame [m/s]
    local* rotation;     // (n, 3, 3) out: rotation of the node from rest to now
    real* b_material;    // (n, 3) out: R^T b, 0 at fixed nodes
    real* y;             // (n, 3) out: R^T dv, 0 at fixed nodes: where the solve starts
    real* values;        // (blocks, 3, 3) out: R^T A R of the node's own block; the identity's at fixed nodes [kg]
};

// Sum of the rotations whose products of quaternions `mean` sums.
INLINE local_mat3 sum_of_rotations(own<local> mean, index i) {
    local_number ww = row_at<10>(mean, i, 0), wx = row_at<10>(mean, i, 1), wy = row_at<10>(mean, i, 2);
    local_number wz = row_at<10>(mean, i, 3), xx = row_at<10>(mean, i, 4), xy = row_at<10>(mean, i, 5);
    local_number xz = row_at<10>(mean, i, 6), yy = row_at<10>(mean, i, 7), yz = row_at<10>(mean, i, 8);
    local_number zz = row_at<10>(mean, i, 9);
    return {{ww + xx - yy - zz, 2 * (xy - wz), 2 * (xz + wy), 2 * (xy + wz), ww - xx + yy - zz, 2 * (yz - wx),
             2 * (xz - wy), 2 * (yz + wx), ww - xx - yy + zz}};
}

// Rotation of a node: the one nearest to the mean of its elements' (Courtecuisse et al. 2010, section 6).
KERNEL(turn, Turn) {
    local_mat3 R = nearest_rotation(sum_of_rotations(p.mean, i));
    number keep = at(p.free, i), d = row_at<1>(p.diagonal, i, 0);
    local_number w = (local_number)at(p.warped, i), k[6];
    for (int m = 0; m < 9; ++m) R.m[m] = m % 4 == 0 ? w * R.m[m] + (1 - w) : w * R.m[m];
    put_row(p.rotation, i, p.n, R.m);
    mat3 Rt = as<number>(transposed(R));
    vec3 b = keep * mul(Rt, load3(p.b, i)), y = keep * mul(Rt, load3(p.dv, i));
    put_row(p.b_material, i, p.n, {b.x, b.y, b.z});
    put_row(p.y, i, p.n, {y.x, y.y, y.z});

    for (int m = 0; m < 6; ++m) k[m] = row_at<6>(p.block, i, m);
    local_mat3 K = symmetric(k[0], k[1], k[2], k[3], k[4], k[5]);
    mat3 A = as<number>(mul(transposed(R), mul(K, R)));
    // R^T d R = d; symmetric to the last bit
    number xx = keep * (A.m[0] + d) + (1 - keep), yy = keep * (A.m[4] + d) + (1 - keep);
    number zz = keep * (A.m[8] + d) + (1 - keep), half = (real)0.5 * keep;
    put_block(p.values, at(p.place, i), i, p.n,
              symmetric(xx, half * (A.m[1] + A.m[3]), half * (A.m[2] + A.m[6]), yy, half * (A.m[5] + A.m[7]), zz).m);
}

struct Advance {
    int n;                  // nodes
    const local* rotation;  // (n, 3, 3)
    const real* y;          // (n, 3) solution in the material frame [m/s]
    real h;                 // [s]
    real* dv;               // (n, 3) out: R y [m/s]
    real* v;                // (n, 3) in, out [m/s]
    real* x;                // (n, 3) in, out [m]
};

// v += dv, x += h v (eq. 2).
KERNEL(advance, Advance) {
    vec3 dv = mul(as<number>(load9(p.rotation, i)), load3(p.y, i));
    vec3 v = load3(p.v, i) + dv;
    store3(p.dv, i, dv);
    store3(p.v, i, v);
    store3(p.x, i, load3(p.x, i) + p.h * v);
}
