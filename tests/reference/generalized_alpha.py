# SPDX-License-Identifier: MIT
"""The generalized-alpha method as Chung and Hulbert (1993) write it, with accelerations and dense matrices.

M ((1 - alpha_m) a' + alpha_m a) = f((1 - alpha_f) x' + alpha_f x, (1 - alpha_f) v' + alpha_f v), in the unknown a'.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from tests.reference.corotational import Array, Solid
from tests.reference.rosenbrock import force


class Parameters(NamedTuple):
    """alpha_m, alpha_f, beta and gamma [-]."""

    alpha_m: float
    alpha_f: float
    beta: float
    gamma: float


def parameters(rho: float) -> Parameters:
    """Of the spectral radius rho at infinite frequency (eq. 17, 18, 25)."""
    alpha_m, alpha_f = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
    return Parameters(alpha_m, alpha_f, (1 - alpha_m + alpha_f) ** 2 / 4, 0.5 - alpha_m + alpha_f)


def amplification(rho: float, wh: float) -> Array:
    """Matrix (3, 3) that takes (x, h v, h^2 a) of x'' = -w^2 x over a step; wh: w h (eq. 8)."""
    p = parameters(rho)
    # Columns: x', h v', h^2 a'; rows: Newmark's two formulas and the balance.
    after = np.array([[1, 0, -p.beta], [0, 1, -p.gamma], [(1 - p.alpha_f) * wh**2, 0, 1 - p.alpha_m]])
    before = np.array([[1, 1, 0.5 - p.beta], [0, 1, 1 - p.gamma], [-p.alpha_f * wh**2, 0, -p.alpha_m]])
    return np.linalg.solve(after, before)


@dataclass
class Motion:
    """A solid with the acceleration (3 n,) that the method carries on."""

    solid: Solid
    a: Array

    @classmethod
    def begun(cls, solid: Solid) -> "Motion":
        """From the acceleration of the state."""
        return cls(solid, force(solid, solid.x.ravel(), solid.v.ravel()) / np.repeat(solid.mass, 3))

    def step(self, rho: float, linearizations: int) -> "Motion":
        """The state after a step, by so many Newton iterations from x_bar = x, v_bar = v, with the solid's tangent."""
        s, p, h = self.solid, parameters(rho), self.solid.h
        x, v, free, m = s.x.ravel(), s.v.ravel(), np.repeat(s.free, 3) > 0, np.repeat(s.mass, 3)
        x_bar, v_bar, after = x, v, self.a
        to_x, to_v = (1 - p.alpha_f) * p.beta * h**2, (1 - p.alpha_f) * p.gamma * h
        drift = x + h * v + h**2 * (0.5 - p.beta) * self.a, v + h * (1 - p.gamma) * self.a  # x', v' with a' = 0
        for _ in range(linearizations):
            at = replace(s, x=x_bar.reshape(-1, 3), v=v_bar.reshape(-1, 3))
            K = at.tangent()
            damping = s.alpha * np.diag(m) + s.beta * K
            A = (1 - p.alpha_m) * np.diag(m) + to_v * damping + to_x * K
            wanted = (1 - p.alpha_f) * drift[0] + p.alpha_f * x, (1 - p.alpha_f) * drift[1] + p.alpha_f * v
            b = (
                force(s, x_bar, v_bar)
                - K @ (wanted[0] - x_bar)
                - damping @ (wanted[1] - v_bar)
                - p.alpha_m * m * self.a
            )
            after = np.zeros_like(x)
            after[free] = np.linalg.solve(A[np.ix_(free, free)], b[free])
            x_bar, v_bar = wanted[0] + to_x * after, wanted[1] + to_v * after
            x_bar, v_bar = np.where(free, x_bar, x), np.where(free, v_bar, v)
        end = drift[0] + h**2 * p.beta * after, drift[1] + h * p.gamma * after
        x, v = (np.where(free, new, old).reshape(-1, 3) for new, old in zip(end, (x, v), strict=True))
        return Motion(replace(s, x=x, v=v), np.where(free, after, 0))
