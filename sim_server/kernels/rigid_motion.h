// SPDX-License-Identifier: MIT
// Momentum and angular momentum of bodies that nothing holds, in a Rosenbrock-W step. Its second stage evaluates the forces at x_2 and
// resolves them at x, so that a stiff body that turns loses angular momentum; and a warped factor turns each node by another rotation,
// so that it loses some of both. The forces of both stages tell what they are at the end of the step, to second order:
//     P' = P + h (F_1 + F_2) / 2,    L' = L + h (T_1 + T_2) / 2,    T_j the torque of the forces at x_j
// and the velocities of the step are made to have them by a rigid motion, v += dv + omega x (x - c), c the centre of mass.
// Shared by native/momentum.h and backends/gpu/momentum.cu.
#pragma once
#include "step_form.h"

struct Vector3 { double x, y, z; };
template <class T> HOST_DEVICE Vector3 at3(const T* a, long long i) { return {(double)a[3 * i], (double)a[3 * i + 1], (double)a[3 * i + 2]}; }
template <class T> HOST_DEVICE void put3(T* a, long long i, Vector3 v) {
    a[3 * i] = (T)v.x;
    a[3 * i + 1] = (T)v.y;
    a[3 * i + 2] = (T)v.z;
}
HOST_DEVICE Vector3 operator+(Vector3 a, Vector3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
HOST_DEVICE Vector3 operator-(Vector3 a, Vector3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
HOST_DEVICE Vector3 operator*(double s, Vector3 a) { return {s * a.x, s * a.y, s * a.z}; }
HOST_DEVICE double dot3(Vector3 a, Vector3 b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
HOST_DEVICE Vector3 cross3(Vector3 a, Vector3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

// Sums over the nodes of a body. Positions r are relative to where its first node was at the start of the step: far from the world's
// origin that costs no digits.
struct MomentumSums {
    double held;              // nodes that something holds; not 0: the body is not free
    double mass;              // kg
    Vector3 linear, angular;  // P' - P and L' - L less those of the velocities at hand: what these lack [N s], [N m s]
    Vector3 first;            // m r [kg m]
    Vector3 squares;          // m r_x r_x, m r_y r_y, m r_z r_z [kg m2]
    Vector3 products;         // m r_y r_z, m r_z r_x, m r_x r_y [kg m2]
};

// Adds half of the impulse of a stage on a node. force: g h times the force [N s].
HOST_DEVICE void add_impulse(MomentumSums& sums, Vector3 r, Vector3 force) {
    const Vector3 impulse = (0.5 / ROS2_GAMMA) * force;
    sums.linear = sums.linear + impulse;
    sums.angular = sums.angular + cross3(r, impulse);
}

// Adds a node that has moved from start with start_v to r with v.
HOST_DEVICE void add_motion(MomentumSums& sums, double mass, Vector3 start, Vector3 start_v, Vector3 r, Vector3 v) {
    sums.mass += mass;
    sums.linear = sums.linear + mass * (start_v - v);
    sums.angular = sums.angular + mass * (cross3(start, start_v) - cross3(r, v));
    sums.first = sums.first + mass * r;
    sums.squares = sums.squares + mass * Vector3{r.x * r.x, r.y * r.y, r.z * r.z};
    sums.products = sums.products + mass * Vector3{r.y * r.z, r.z * r.x, r.x * r.y};
}

struct RigidMotion { Vector3 centre, dv, omega; };

// omega of I omega = l, I from the second moments about the centre; zero for a body without extent across an axis.
HOST_DEVICE Vector3 spin_of(Vector3 squares, Vector3 products, Vector3 l) {
    const double size = squares.x + squares.y + squares.z;
    const Vector3 a = {squares.y + squares.z, -products.z, -products.y}, b = {-products.z, squares.x + squares.z, -products.x};
    const Vector3 c = {-products.y, -products.x, squares.x + squares.y};
    const Vector3 bc = cross3(b, c), ca = cross3(c, a), ab = cross3(a, b);
    const double det = dot3(a, bc);
    if (!(det > 1e-9 * size * size * size)) return {0, 0, 0};
    return (1 / det) * (l.x * bc + l.y * ca + l.z * ab);
}

// The motion that adds the momenta that a body lacks.
HOST_DEVICE RigidMotion rigid_motion(const MomentumSums& sums) {
    const Vector3 c = (1 / sums.mass) * sums.first, dv = (1 / sums.mass) * sums.linear;
    const Vector3 squares = sums.squares - sums.mass * Vector3{c.x * c.x, c.y * c.y, c.z * c.z};
    const Vector3 products = sums.products - sums.mass * Vector3{c.y * c.z, c.z * c.x, c.x * c.y};
    return {c, dv, spin_of(squares, products, sums.angular - cross3(c, sums.linear))};
}

HOST_DEVICE Vector3 moved(const RigidMotion& motion, Vector3 r, Vector3 v) {
    return v + motion.dv + cross3(motion.omega, r - motion.centre);
}
