# SPDX-License-Identifier: MIT
"""Factor makers that fail: nobody there, or a factor that is not the matrix's."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor
from sim_server.simulation import Simulation
from sim_server.updates.factor_source import FactorSource, Inline, Job

Values = NDArray[Any]
Source = Callable[[Simulation], FactorSource]


class Nobody(FactorSource):
    """No worker, ever."""

    def ready(self) -> int:
        return 0

    def submit(self, job: Job) -> bool:
        return False

    def poll(self) -> list[Factor]:
        return []

    def failures(self) -> list[tuple[str, str]]:
        return []


class Poisoned(Inline):
    """Right factors whose values are replaced; they pass every check that looks at shape and pattern only."""

    def __init__(self, simulation: Simulation, poison: Callable[[Values], Values]):
        super().__init__({b.name: simulation.system.body_pattern(b.first, b.last) for b in simulation.world.bodies})
        self._poison = poison

    def poll(self) -> list[Factor]:
        return [replace(f, values=self._poison(f.values).astype(f.values.dtype)) for f in super().poll()]


def poisoned(poison: Callable[[Values], Values]) -> Source:
    return lambda simulation: Poisoned(simulation, poison)


def nobody(simulation: Simulation) -> FactorSource:
    return Nobody()


def one_nan(values: Values) -> Values:
    values = values.copy()
    values[len(values) // 2] = np.nan
    return values


def noisy(values: Values) -> Values:
    """Every entry of L changed by up to a half: the factor of quite another positive definite matrix."""
    return values * np.random.default_rng(1).uniform(0.5, 1.5, len(values))


def shuffled(values: Values) -> Values:
    return np.random.default_rng(2).permutation(values)


def ones(values: Values) -> Values:
    """Well formed, positive definite, and of no use whatever."""
    return np.ones_like(values)


def overflowing(values: Values) -> Values:
    """So small that P^-1 r overflows in float32."""
    return values * 1e-36
