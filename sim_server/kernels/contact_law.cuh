// SPDX-License-Identifier: MIT
// The law of a contact: a stiff layer of thickness d in front of a plane, with elastic-plastic friction; shared by both devices.
// s is the displacement in the step of the point that may touch, h^2 the product of what forces are to impulses and velocities to
// displacements (dx_dv and force_coefficient, mechanics/integrator.py), l the normal force that limits friction.
//
//     g = gap + n.s                             distance at the end of the step
//     lambda = max(0, k (d - g))                normal force
//     t = t_0 - k T (s - drift)                 trial of friction, T = I - n n^T, t_0 the friction force of the last step
//     tau = t if |t| <= mu l, else mu l t / |t|
//
// With l held, -(lambda n + tau) is the gradient by s of a convex, continuously differentiable function. -d(force)/ds is
//     k n n^T where lambda > 0,   and   k T where it sticks,   k (mu l / |t|) (T - t t^T / |t|^2)   where it slips;
// dtau/dlambda is left out, since it is not symmetric: a pass holds l. Newton's method with that goes to and fro between sticking and
// slipping, so a pass has k (mu l / |t|) (T - (e w^T + w e^T) / 2) in its place, e = t / |t|: w mu l is the dual variable, a friction
// force that each pass linearizes along with s and keeps within mu l. It starts between the secant (w = 0), which never overshoots, and
// ends at the derivative (w = e), which converges fast (Chan, Golub and Mulet, A nonlinear primal-dual method for total
// variation-based image restoration, 1999, whose function is the same). t_0 is an anchor, so that a contact that sticks does not creep;
// it slips by mu l / k, elastically, before it slides. (Elastic-plastic friction: Wriggers, Computational Contact Mechanics, 2006,
// section 5.2; Huber's function as its potential.)
#pragma once
#include "shapes.cuh"

constexpr int CORNERS = 4;      // of a row, at most

struct ContactRow {             // views of a row's entries
    const double *normal, *drift, *anchor;  // (3,) each
    double gap, thickness, stiffness, friction;
};

struct ContactForce {
    double normal;              // lambda [N]; of a row taken as closed it may be negative
    double traction[3];         // tau [N]
    double slip;                // mu l / |t| of a row that slips; 1: it sticks
    bool closed;                // the normal stiffness counts
};

// limit: l [N]. closed: the row counts as closed whatever its gap.
HOST_DEVICE ContactForce contact_force(const ContactRow& row, const double* s, double limit, bool closed) {
    const double *n = row.normal, lambda = row.stiffness * (row.thickness - row.gap - dot3(n, s));
    ContactForce f = {lambda, {0, 0, 0}, 1, true};
    if (!closed && !(lambda > 0)) { f.normal = 0; f.closed = false; }
    const double most = row.friction * limit;
    if (!(most > 0)) { f.slip = 0; return f; }
    const double e[3] = {s[0] - row.drift[0], s[1] - row.drift[1], s[2] - row.drift[2]}, en = dot3(n, e);
    for (int c = 0; c < 3; ++c) f.traction[c] = row.anchor[c] - row.stiffness * (e[c] - en * n[c]);
    const double size = sqrt(dot3(f.traction, f.traction));
    if (size <= most) return f;
    f.slip = most / size;
    for (int c = 0; c < 3; ++c) f.traction[c] *= f.slip;
    return f;
}

// What a pass takes for -d(force)/ds times `scale`, upper triangle 00, 01, 02, 11, 12, 22; both parts as the force was evaluated.
// dual: dual variable of friction [N]; with that of f.traction it is the derivative.
HOST_DEVICE void contact_stiffness(const ContactRow& row, const ContactForce& f, const double* dual, double scale, double* k) {
    const double *n = row.normal, normal = f.closed ? scale * row.stiffness : 0, tangential = f.slip * scale * row.stiffness;
    const double size2 = dot3(f.traction, f.traction), along = f.slip < 1 && size2 > 0 ? 0.5 * tangential / size2 : 0;
    int m = 0;
    for (int i = 0; i < 3; ++i)
        for (int j = i; j < 3; ++j)
            k[m++] = (normal - tangential) * n[i] * n[j] + (i == j ? tangential : 0) -
                     along * (f.traction[i] * dual[j] + dual[i] * f.traction[j]);
}

// Takes the dual variable back into the disc of friction.
HOST_DEVICE void bound_dual(const ContactRow& row, double limit, double* dual) {
    const double most = row.friction * limit, size = sqrt(dot3(dual, dual));
    for (int c = 0; c < 3 && size > most; ++c) dual[c] *= most / size;
}

// Moves the dual variable by the linearization that a pass was made with. f: at its start. step: displacement that the pass made [m].
HOST_DEVICE void move_dual(const ContactRow& row, const ContactForce& f, const double* step, double* dual) {
    const double* n = row.normal;
    const double along = dot3(n, step), size2 = dot3(f.traction, f.traction);
    if (!(f.slip > 0) || !(size2 > 0 || f.slip == 1)) return;
    double change[3];  // of the trial
    for (int c = 0; c < 3; ++c) change[c] = -row.stiffness * (step[c] - along * n[c]);
    const double part = f.slip < 1 ? dot3(f.traction, change) / size2 : 0;
    for (int c = 0; c < 3; ++c) dual[c] = f.traction[c] + f.slip * (change[c] - part * dual[c]);
}

// Turns v by the smallest rotation from the normal `before` to `now`, and takes what is left of it along `now` away.
HOST_DEVICE void turn_with(const double* before, const double* now, double* v) {
    const double axis[3] = {before[1] * now[2] - before[2] * now[1], before[2] * now[0] - before[0] * now[2],
                            before[0] * now[1] - before[1] * now[0]};
    const double cosine = dot3(before, now);
    if (cosine > -0.999) {
        const double along = dot3(axis, v) / (1 + cosine);
        const double turned[3] = {cosine * v[0] + axis[1] * v[2] - axis[2] * v[1] + along * axis[0],
                                  cosine * v[1] + axis[2] * v[0] - axis[0] * v[2] + along * axis[1],
                                  cosine * v[2] + axis[0] * v[1] - axis[1] * v[0] + along * axis[2]};
        for (int k = 0; k < 3; ++k) v[k] = turned[k];
    }
    const double out = dot3(now, v);
    for (int k = 0; k < 3; ++k) v[k] -= out * now[k];
}
