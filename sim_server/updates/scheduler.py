# SPDX-License-Identifier: MIT
"""Whose matrix is factorized next: pure functions of counters, no clock, no I/O.

excess       the rule of Courtecuisse et al. 2010, section 4: each object sums up its CG iterations above a floor, and
             the object with the largest sum goes next; a matrix that goes out sets its object's sum back to zero. Two
             things are ours: the sum begins anew when the factor is taken up, since what was summed while it was made
             is what it is for; and sums are compared as they will be a few steps from now if the excess of the last
             solve goes on, so that an object that has just been seized need not add up its claim first
round_robin  whoever was sent longest ago

Whatever the rule, an object whose last matrix is `overdue` goes first, so none starves.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import ceil, inf

from sim_server.scene.solver_options import Rule

AHEAD = 10.0  # steps for which the excess of the last solve is taken to go on
DOUBLINGS = 10  # of the floor of an object whose jobs fail


@dataclass(frozen=True)
class Need:
    """What is known of an object. excess: summed iterations above the floor; waited: steps since its last matrix went
    out (None: none did yet); in_flight: a matrix of it is being factorized; age: steps since the matrix of its factor
    (None: it has none); cost: of an iteration, service: of a factorization, each in any unit as long as it is the same
    for all; failures: jobs in a row that came to nothing; lost: summed iterations above the floor of solves with the
    factor in use; trial: a new factor is wanted to be tried out, whatever was lost; latest: excess of the last
    solve."""

    object: str
    excess: float
    waited: int | None
    in_flight: bool
    age: int | None = None
    cost: float = 1.0
    service: float = 1.0
    failures: int = 0
    lost: float = 0.0
    trial: bool = False
    latest: float = 0.0


def excess(iterations: int, floor: int) -> int:
    """What a solve adds to its object's sum."""
    return max(0, iterations - floor)


def claim(need: Need) -> float:
    """The sum as it will be if the latest excess goes on (excess)."""
    return need.excess + AHEAD * need.latest


def pays(need: Need, threshold: float = 1.0) -> bool:
    """adaptive: whether a new factor is worth its time now.

    It is once the iterations lost to the factor in use have cost `threshold` times a factorization. Where they grow
    steadily with its age, by a in each step at a cost of c, that is the best there is: a factor of cost F each T steps
    makes F / T + a c T / 2 a step, least where a c T^2 / 2, what was lost, is F. An object without a factor, or with
    one to be tried out, does not wait. cost and service must be in the same unit here.
    """
    return need.age is None or need.trial or need.lost * need.cost >= threshold * need.service


_PRIORITY: dict[Rule, Callable[[Need], float]] = {
    "excess": claim,
    "round_robin": lambda need: need.waited or 0,
}


def pick(
    needs: Iterable[Need], places: int, floor_steps: int = 1, rule: Rule = "excess", overdue: float = inf
) -> list[str]:
    """Up to `places` objects, most urgent first.

    Objects of which no matrix went out yet come first; then those that waited `overdue` steps, longest first; then by
    the rule; among equals who waited longest, then by order. An object in flight or whose last matrix went out less
    than floor_steps ago (twice as long after each failure) is left out.
    """
    priority = _PRIORITY[rule]

    def urgency(need: Need) -> tuple[int, float, int]:
        waited = need.waited or 0
        if need.waited is None:
            return 0, -need.excess, 0
        return (1, -waited, 0) if waited >= overdue else (2, -priority(need), -waited)

    ready = [n for n in needs if not n.in_flight and (n.waited is None or n.waited >= held_back(n, floor_steps))]
    ready.sort(key=urgency)
    return [n.object for n in ready[: max(places, 0)]]


def held_back(need: Need, floor_steps: int) -> int:
    """Fewest steps between two matrices of an object."""
    return floor_steps * 2 ** min(need.failures, DOUBLINGS)


def one_round(services: Sequence[float], workers: int) -> float:
    """Steps in which `workers` serve every object once. services: steps from matrix to factor of each; inf without
    workers."""
    return sum(services) / workers if workers > 0 else inf


def overdue_after(rounds: float, services: Sequence[float], workers: int) -> float:
    """Steps after which an object goes next whatever the rule: so many rounds, inf without workers."""
    return rounds * one_round(services, workers)


def oldest_possible(overdue: float, services: Sequence[float], workers: int) -> int:
    """Bound on the age of any factor in steps, -1 without workers: overdue, then behind all the others, and a matrix
    is copied, factorized and taken up while the factor before is still in use."""
    if workers < 1 or not services:
        return -1
    return ceil(overdue + one_round(services, workers) + 2 * max(services) + 2)
