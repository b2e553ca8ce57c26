# SPDX-License-Identifier: MIT
"""Whose matrix is factorized next: pure functions of counters, no clock, no I/O.

The rule of Courtecuisse et al. 2010, section 4: each object sums up its CG iterations above a floor, and the object
with the largest sum goes next. A matrix that goes out sets its object's sum back to zero.
"""

from collections.abc import Iterable
from dataclasses import dataclass


@dataclass(frozen=True)
class Need:
    """What is known of an object. excess: summed iterations above the floor; waited: steps since its last matrix went
    out (None: none did yet); in_flight: a matrix of it is being factorized."""

    object: str
    excess: float
    waited: int | None
    in_flight: bool


def excess(iterations: int, floor: int) -> int:
    """What a solve adds to its object's sum."""
    return max(0, iterations - floor)


def pick(needs: Iterable[Need], places: int, floor_steps: int = 1) -> list[str]:
    """Up to `places` objects, most urgent first.

    Objects without any factor come first, then by excess, then by who waited longest, then by order. An object in
    flight or whose last matrix went out less than floor_steps ago is left out.
    """
    ready = [n for n in needs if not n.in_flight and (n.waited is None or n.waited >= floor_steps)]
    ready.sort(key=lambda n: (n.waited is not None, -n.excess, -(n.waited or 0)))
    return [n.object for n in ready[: max(places, 0)]]
