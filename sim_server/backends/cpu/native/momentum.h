// SPDX-License-Identifier: MIT
// Momentum and angular momentum of bodies that nothing holds, in a Rosenbrock-W step. Its second stage evaluates the forces at x_2 and
// resolves them at x, so that a stiff body that turns loses angular momentum; and a warped factor turns each node by another rotation,
// so that it loses some of both. The forces of both stages tell what they are at the end of the step, to second order:
//     P' = P + h (F_1 + F_2) / 2,    L' = L + h (T_1 + T_2) / 2,    T_j the torque of the forces at x_j
// and the velocities of the step are made to have them by a rigid motion, v += dv + omega x (x - c).
#pragma once
#include "loop.h"

struct Vector3 { double x, y, z; };
static Vector3 at3(const double* a, int64_t i) { return {a[3 * i], a[3 * i + 1], a[3 * i + 2]}; }
static Vector3 operator+(Vector3 a, Vector3 b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
static Vector3 operator-(Vector3 a, Vector3 b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
static Vector3 operator*(double s, Vector3 a) { return {s * a.x, s * a.y, s * a.z}; }
static Vector3 cross3(Vector3 a, Vector3 b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }

// Adds h / 2 times the force and torque (about the world's origin) of a stage, from b before it is solved. False if a spring holds the
// body: then it is not free.
static bool add_impulses(const Loop& loop, const Body& body, double (&impulse)[6]) {
    const Stages& stages = *loop.stages;
    const double weight = 0.5 * stages.euler_coefficients[0] / stages.own_coefficients[0];  // h / 2 over the g h in b
    Vector3 force = {}, torque = {};
    for (int i = body.first; i < body.last; ++i) {
        const double mass = stages.mass[i], inert = mass * stages.weight[i] / stages.share[i];  // without springs
        if (stages.diagonal[i] > inert * (1 + 1e-9)) return false;
        const Vector3 f = at3(stages.b, i) - mass * at3(stages.inertial_increment, i);
        force = force + f;
        torque = torque + cross3(at3(loop.x, i), f);
    }
    const Vector3 both[2] = {weight * force, weight * torque};
    for (int k = 0; k < 2; ++k) {
        impulse[3 * k] += both[k].x;
        impulse[3 * k + 1] += both[k].y;
        impulse[3 * k + 2] += both[k].z;
    }
    return true;
}

struct Momenta { Vector3 linear, angular, centre; double mass; };

static Momenta momenta_of(const Body& body, const double* mass, const double* x, const double* v) {
    Momenta m = {};
    for (int i = body.first; i < body.last; ++i) {
        m.mass += mass[i];
        m.linear = m.linear + mass[i] * at3(v, i);
        m.angular = m.angular + mass[i] * cross3(at3(x, i), at3(v, i));
        m.centre = m.centre + mass[i] * at3(x, i);
    }
    m.centre = (1 / m.mass) * m.centre;
    return m;
}

// omega of I omega = l; zero for a body without extent across an axis.
static Vector3 spin_of(const Body& body, const double* mass, const double* x, Vector3 centre, Vector3 l) {
    double xx = 0, yy = 0, zz = 0, xy = 0, xz = 0, yz = 0;
    for (int i = body.first; i < body.last; ++i) {
        const Vector3 r = at3(x, i) - centre;
        xx += mass[i] * r.x * r.x; yy += mass[i] * r.y * r.y; zz += mass[i] * r.z * r.z;
        xy += mass[i] * r.x * r.y; xz += mass[i] * r.x * r.z; yz += mass[i] * r.y * r.z;
    }
    const Vector3 a = {yy + zz, -xy, -xz}, b = {-xy, xx + zz, -yz}, c = {-xz, -yz, xx + yy};
    const Vector3 bc = cross3(b, c), ca = cross3(c, a), ab = cross3(a, b);
    const double det = a.x * bc.x + a.y * bc.y + a.z * bc.z, size = xx + yy + zz;
    if (!(det > 1e-9 * size * size * size)) return {};
    return (1 / det) * (l.x * bc + l.y * ca + l.z * ab);
}

// Gives the velocities of the step the momenta that its forces make. impulse: of both stages.
static void set_momenta(Loop& loop, const Body& body, const double (&impulse)[6]) {
    const Stages& stages = *loop.stages;
    const Momenta before = momenta_of(body, stages.mass, stages.start_x, stages.start_v);
    const Momenta now = momenta_of(body, stages.mass, loop.x, loop.v);
    const Vector3 linear = {impulse[0], impulse[1], impulse[2]}, angular = {impulse[3], impulse[4], impulse[5]};
    const Vector3 dv = (1 / now.mass) * (before.linear + linear - now.linear);
    const Vector3 missing = before.angular + angular - now.angular - now.mass * cross3(now.centre, dv);
    const Vector3 omega = spin_of(body, stages.mass, loop.x, now.centre, missing);
    for (int i = body.first; i < body.last; ++i) {
        const Vector3 v = at3(loop.v, i) + dv + cross3(omega, at3(loop.x, i) - now.centre);
        loop.v[3 * i] = v.x; loop.v[3 * i + 1] = v.y; loop.v[3 * i + 2] = v.z;
    }
}
