// SPDX-License-Identifier: MIT
// Nodal kernels of every step, whatever its effects.
#define WIDE
#include "polar.cuh"
#include "coalesced_io.cuh"

struct Start {
    int n;               // nodes
    const real* mass;    // (n,) [kg]
    own<real> diagonal;  // (n, 1) out: what goes onto the diagonal of A [kg]
    own<real> b;         // (n, 3) out: right-hand side, world frame [N s]
    own<local> block;    // (n, 6) out: upper triangle of the node's own block of A, world frame [kg]
    own<local> mean;     // (n, 10) out: upper triangle of the sum of q q^T, q the elements' rotations
};

// Begins the system with the lumped masses; the effects then add to it.
KERNEL(start, Start) {
    row_put<1>(p.diagonal, i, 0, at(p.mass, i));
    store3(p.b, i, vec3{});
    for (int k = 0; k < 6; ++k) row_put<6>(p.block, i, k, local_number{});
    for (int k = 0; k < 10; ++k) row_put<10>(p.mean, i, k, local_number{});
}

struct Rotate {
    int n;                     // nodes
    const real* free;          // (n,) 1, or 0 at fixed nodes
    const int* body;           // (n,) of the node
    const int* warped;         // (bodies,) 1 where frames follow the nodes' rotations, 0 where they stay the identity
    const int* place;          // (n,) of the node's own block in the full pattern
    own<local> mean;           // (n, 10) upper triangle of the sum of q q^T
    own<real> b;               // (n, 3) world frame [N s]
    own<real> diagonal;        // (n, 1) [kg]
    own<local> block;          // (n, 6) upper triangle, world frame [kg]
    const real* dv;            // (n, 3) solution of the last step, world frame [m/s]
    const real* guess;         // (n, 3) of that of this step, or the same array [m/s]
    const real* x;             // (n, 3) [m]
    const real* v;             // (n, 3) velocity that the step begins with; zero without inertia [m/s]
    const real* extent;        // (n,) of the node's body [m]
    const real* inverse_time;  // (n,) 1 / (c + beta), which makes i K of a block i (c + beta) K; c world.dx_dv [1/s]
    real h;                    // time step [s]
    int whole;                 // 0: leave out the block of A
    local* rotation;           // (n, 3, 3) out: frame of the node: its rotation from rest to now, or the identity
    real* b_material;          // (n, 3) out: R^T b, 0 at fixed nodes
    real* last_b;              // (n, 3) in, out: the same of the evaluation before, which no solve changes
    real* y;                   // (n, 3) out: start of the solve: R^T guess; R^T (-v) where the node rests; 0 at fixed nodes
    int* moving;               // (bodies,) out: set to 1 if a node of the body does not rest
    real* values;              // (blocks, 3, 3) out: R^T A R of the node's own block; the identity's at fixed nodes [kg]
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

// Frame of a node: the rotation nearest to the mean of its elements' (Courtecuisse et al. 2010, section 6), or the identity.
INLINE local_mat3 frame_of(const Rotate& p, index i) {
    index warped = at(p.warped, at(p.body, i));
    quaternion<local_number> rest = {local_number{} + 1, {}, {}, {}}, q = rest;
    if (any(warped)) {
        auto follows = (local_number)as_number(warped) > 0;
        q = nearest_quaternion(sum_of_rotations(p.mean, i));
        q = {follows ? q.w : rest.w, follows ? q.x : rest.x, follows ? q.y : rest.y, follows ? q.z : rest.z};
    }
    return rotation_matrix(q);
}

// A node rests if a solve with the present forces has left it where it is: if
//   - it moves in a step by less than the rounding error of its position,
//   - b there is less than SAFETY times the rounding error of the forces on it: its own stiffness times the errors of positions (of
//     x) and of strains (of the body's extent); at rest b is 0.1 of that bound, and
//   - b is what it was one evaluation ago, within what velocities below that error change it by; where nothing moves, within the
//     rounding of double precision.
// Size alone does not tell rounding from a load, which may be small at each node and large for the body (a nearly incompressible bar
// under its weight, a slender one under a push): a load that is new is solved for, however small.
// A node at rest is not solved for: the step sets its velocity to zero.
constexpr real SINGLE = (real)1.2e-7, DOUBLE = (real)2.2e-16;
template <class T> constexpr real EPSILON = sizeof(entry<T>) == 8 ? DOUBLE : SINGLE;
constexpr int SAFETY = 4;

INLINE number largest(vec3 a) { return larger(larger(magnitude(a.x), magnitude(a.y)), magnitude(a.z)); }

INLINE auto rests(const Rotate& p, index i, vec3 b, vec3 v, number stiffness) {
    number extent = at(p.extent, i), from = largest(load3(p.x, i)) + extent, k = SAFETY * stiffness, per_time = at(p.inverse_time, i);
    number place = EPSILON<number> * from, strain = EPSILON<local_number> * extent, speed = largest(v);
    auto stood = p.h * larger(speed, largest(load3(p.dv, i))) <= DOUBLE * place;
    number change = largest(b - load3(p.last_b, i)), allowed = k * (stood ? DOUBLE * from * per_time : place / p.h);
    return (largest(b) <= k * per_time * larger(place, strain)) & (p.h * speed <= place) & (change <= allowed);
}

KERNEL(rotate, Rotate) {
    local_mat3 R = frame_of(p, i);
    number keep = at(p.free, i), d = row_at<1>(p.diagonal, i, 0);
    local_number k[6];
    put_row(p.rotation, i, p.n, R.m);
    mat3 Rt = as<number>(transposed(R));
    for (int m = 0; m < 6; ++m) k[m] = row_at<6>(p.block, i, m);
    auto fixed = keep == 0;  // includes all nodes of a frozen body, whatever was assembled there
    vec3 zero = {}, b = select(fixed, zero, mul(Rt, load3(p.b, i))), v = load3(p.v, i);
    auto still = fixed | rests(p, i, b, v, (number)((k[0] + k[3] + k[5]) / 3));
    vec3 y = select(fixed, zero, mul(Rt, select(still, -v, load3(p.guess, i))));
    put_row(p.b_material, i, p.n, {b.x, b.y, b.z});
    put_row(p.last_b, i, p.n, {b.x, b.y, b.z});
    put_row(p.y, i, p.n, {y.x, y.y, y.z});
    mark(p.moving, at(p.body, i), !still);

    if (p.whole == 0) return;
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
    real* before;           // (n, 3) out: x when the step began [m]
};

// v += dv, x += h v (eq. 2). If the forces of a body are NaN, so is y (backends/cpu/native/pcg.h): the body goes back to the start
// of the step before, where forces were finite, and rests there. This adds no energy, and the body moves on unless the same load
// inverts it again.
KERNEL(advance, Advance) {
    vec3 y = load3(p.y, i), dv = mul(as<number>(load9(p.rotation, i)), y), before = load3(p.v, i), v = before + dv, zero = {};
    vec3 x = load3(p.x, i);
    auto refused = y.x != y.x, known = dot(before, zero) == 0;
    vec3 after = x + p.h * select(refused, select(known, -before, zero), v);
    v = select(refused, zero, v);
    store3(p.dv, i, select(refused, zero, dv));
    put_row(p.v, i, p.n, {v.x, v.y, v.z});
    put_row(p.x, i, p.n, {after.x, after.y, after.z});
    put_row(p.before, i, p.n, {x.x, x.y, x.z});
}
