# SPDX-License-Identifier: MIT
"""A step of ROS2 as a W-method with dense matrices, in the form with K (Verwer, Spee, Blom and Hundsdorfer 1999).

A = M - g h D - (g h)^2 J with J = -K the slope of the forces and D = -alpha M - beta K; K and A are those of the step,
or any other. A body that nothing holds then gets the momenta that its forces make (sim_server/kernels/rigid_motion.h),
found here as the least change of v.
"""

from dataclasses import replace

import numpy as np

from tests.reference.corotational import Array, Solid

GAMMA = 1 - 1 / np.sqrt(2)


def force(solid: Solid, x: Array, v: Array) -> Array:
    """f(x, v) with gravity, the damping of mass and stiffness; 0 at fixed nodes, (3 n,)."""
    at = replace(solid, x=x.reshape(-1, 3), v=v.reshape(-1, 3))
    m = at.mass[:, None]
    f = at.forces() + m * np.array(at.gravity) - at.alpha * m * at.v
    f -= at.beta * (at.tangent() @ v).reshape(-1, 3)
    return (f * at.free[:, None]).ravel()


def warped(stiffness: Array, before: Array, now: Array) -> Array:
    """W K W^T with blocks R_s R_t^T of W: the stiffness of an older state t, turned with the nodes to the state s."""
    n = len(now)
    turn = np.zeros((3 * n, 3 * n))
    for i, (Rt, Rs) in enumerate(zip(before, now, strict=True)):
        turn[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = Rs @ Rt.T
    return turn @ stiffness @ turn.T


def step(solid: Solid, stiffness: Array | None = None) -> tuple[Array, Array, Array]:
    """x, v at the end and the estimate of the error at each node. stiffness: K; None: that of the state."""
    g, h = GAMMA, solid.h
    K = solid.tangent() if stiffness is None else stiffness
    m = np.repeat(solid.mass, 3)
    free = np.repeat(solid.free, 3) > 0
    D = -solid.alpha * np.diag(m) - solid.beta * K
    A = (np.diag(m) - g * h * D + (g * h) ** 2 * K)[np.ix_(free, free)]

    def solve(b: Array) -> Array:
        k = np.zeros_like(b)
        k[free] = np.linalg.solve(A, b[free])
        return k

    x, v = solid.x.ravel(), solid.v.ravel()
    k1v = solve(force(solid, x, v) - g * h * K @ v)
    k1x = v + g * h * k1v
    x1, v1, s = x + h * k1x, v + h * k1v, v + h * k1v - 2 * k1x
    k2v = solve(force(solid, x1, v1) - 2 * m * k1v - g * h * K @ s)
    k2x = s + g * h * k2v
    estimate = np.linalg.norm((h * (k1x + k2x) / 2).reshape(-1, 3), axis=1)
    ended = (x + h * (3 * k1x + k2x) / 2).reshape(-1, 3), (v + h * (3 * k1v + k2v) / 2).reshape(-1, 3)
    if free.all():
        stages = [(at.reshape(-1, 3), force(solid, at, v_at).reshape(-1, 3)) for at, v_at in ((x, v), (x1, v1))]
        linear, angular = momenta(solid.mass, solid.x, solid.v)
        linear = linear + h / 2 * sum(f.sum(axis=0) for _, f in stages)
        angular = angular + h / 2 * sum(np.cross(at, f).sum(axis=0) for at, f in stages)
        ended = ended[0], with_momenta(solid.mass, *ended, linear, angular)
    return *ended, estimate


def momenta(mass: Array, x: Array, v: Array) -> tuple[Array, Array]:
    """Linear and angular momentum about the origin."""
    return mass @ v, (mass[:, None] * np.cross(x, v)).sum(axis=0)


def with_momenta(mass: Array, x: Array, v: Array, linear: Array, angular: Array) -> Array:
    """v with these momenta: the least change in the norm of the masses, which is a rigid motion."""
    rows = np.concatenate([np.kron(np.ones(len(x)), np.eye(3)), np.hstack([skew(p) for p in x])])
    m = np.repeat(mass, 3)
    missing = np.concatenate([linear, angular]) - rows @ (m * v.ravel())
    return v + (rows.T @ np.linalg.solve(rows @ (m[:, None] * rows.T), missing)).reshape(-1, 3)


def skew(a: Array) -> Array:
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])
