# SPDX-License-Identifier: MIT
"""A step of ROS2 as a W-method with dense matrices, in the form with K (Verwer, Spee, Blom and Hundsdorfer 1999).

A = M - g h D - (g h)^2 J with J = -K the slope of the forces and D = -alpha M - beta K; K and A are those of the step,
or any other.
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
    ended = x + h * (3 * k1x + k2x) / 2, v + h * (3 * k1v + k2v) / 2
    return ended[0].reshape(-1, 3), ended[1].reshape(-1, 3), estimate
