# SPDX-License-Identifier: MIT
"""Whose matrix is factorized next: pure functions of counters, no clock, no I/O.

excess       the rule of Courtecuisse et al. 2010, section 4: each object sums up its CG iterations above a floor, and
             the object with the largest sum goes next; a matrix that is sent sets its object's sum back to zero. Two
             things are ours: the sum begins anew when the factor is taken up, since what was summed while it was made
             is what it is for; and sums are compared as they will be a few steps from now if the excess of the last
             solve goes on, so that an object that has just been seized need not add up its sum first. Steps that do
             not iterate add the estimate of their error over the bound instead (body_state.excess)
round_robin  the object whose matrix was sent longest ago

Whatever the rule, an object whose last matrix is `overdue` goes first, so none starves.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import ceil, inf

from sim_server.scene.solver_options import Rule

OUTLOOK = 10.0  # steps for which the excess of the last solve is taken to go on
MAX_DOUBLINGS = 10  # of the least interval between matrices of an object whose jobs fail


@dataclass(frozen=True)
class UpdateRequest:
    """What the scheduler knows of an object.

    excess: summed iterations above the floor
    waited: steps since its last matrix was sent; None: none was yet
    in_flight: a matrix of it is being copied or factorized
    age: steps since the matrix of its factor; None: it has no factor
    iteration_cost, factorization_cost: in any unit, as long as it is the same for all objects
    failures: jobs in a row that brought no factor
    lost: summed iterations above the floor of solves with the factor in use
    on_trial: a new factor is wanted for a comparison, whatever was lost
    latest: excess of the last solve
    """

    object: str
    excess: float
    waited: int | None
    in_flight: bool
    age: int | None = None
    iteration_cost: float = 1.0
    factorization_cost: float = 1.0
    failures: int = 0
    lost: float = 0.0
    on_trial: bool = False
    latest: float = 0.0


def expected_excess(request: UpdateRequest) -> float:
    """Returns the sum of an object as it will be OUTLOOK steps from now if the excess of the last solve goes on."""
    return request.excess + OUTLOOK * request.latest


def is_worthwhile(request: UpdateRequest, threshold: float = 1.0) -> bool:
    """True if a new factor is worth its time now (the policy `adaptive`).

    It is once the iterations lost to the factor in use have cost `threshold` times a factorization. Where they grow
    steadily with its age, by a in each step at a cost of c, that is the best there is: a factor of cost F each T steps
    makes F / T + a c T / 2 a step, least where a c T^2 / 2, what was lost, is F. An object without a factor, or with
    one to be tried out, does not wait. The two costs must be in the same unit here.
    """
    lost = request.lost * request.iteration_cost
    return request.age is None or request.on_trial or lost >= threshold * request.factorization_cost


_PRIORITY: dict[Rule, Callable[[UpdateRequest], float]] = {
    "excess": expected_excess,
    "round_robin": lambda request: request.waited or 0,
}


def pick(
    requests: Iterable[UpdateRequest],
    places: int,
    min_interval: int = 1,
    rule: Rule = "excess",
    overdue: float = inf,
) -> list[str]:
    """Returns up to `places` objects, the most urgent first.

    Objects of which no matrix was sent yet come first; then those that waited `overdue` steps, longest first; then by
    the rule; among equals the one that waited longest, then by order. An object in flight is left out, and one whose
    last matrix was sent less than min_interval steps ago (twice as long after each failure).
    """
    priority = _PRIORITY[rule]

    def urgency(request: UpdateRequest) -> tuple[int, float, int]:
        waited = request.waited or 0
        if request.waited is None:
            return 0, -request.excess, 0
        return (1, -waited, 0) if waited >= overdue else (2, -priority(request), -waited)

    ready = [
        r for r in requests if not r.in_flight and (r.waited is None or r.waited >= _with_backoff(r, min_interval))
    ]
    ready.sort(key=urgency)
    return [r.object for r in ready[: max(places, 0)]]


def _with_backoff(request: UpdateRequest, min_interval: int) -> int:
    """Returns the least number of steps between two matrices of an object."""
    return min_interval << min(request.failures, MAX_DOUBLINGS)


def round_duration(latencies: Sequence[float], workers: int) -> float:
    """Returns the steps in which `workers` serve every object once; inf without workers.

    latencies: steps from matrix to factor of each object
    """
    return sum(latencies) / workers if workers > 0 else inf


def overdue_after(rounds: float, latencies: Sequence[float], workers: int) -> float:
    """Returns the steps after which an object goes next whatever the rule: `rounds` rounds, inf without workers."""
    return rounds * round_duration(latencies, workers)


def max_factor_age(overdue: float, latencies: Sequence[float], workers: int) -> int:
    """Returns a bound on the age of any factor in steps, -1 without workers.

    An object waits until it is overdue and then behind all the others, and its matrix is copied, factorized and taken
    up while the factor before is still in use.
    """
    if workers < 1 or not latencies:
        return -1
    return ceil(overdue + round_duration(latencies, workers) + 2 * max(latencies) + 2)
