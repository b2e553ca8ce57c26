# SPDX-License-Identifier: MIT
"""Whose matrix is factorized next: pure functions of counters, no clock, no I/O.

excess       the rule of Courtecuisse et al. 2010, section 4: each object sums up its CG iterations above a floor, and
             the object with the largest sum goes next; a matrix that is sent sets its object's sum back to zero. Three
             things are ours: the sum begins anew when the factor is taken up, since what was summed while it was made
             is what it is for; sums are compared as they will be a few steps from now if the excess of the last
             solve goes on, so that an object that has just been seized need not add up its sum first; and they are
             compared times the square root of the steps since the last matrix: else one that always iterates three
             times as much, whatever its factor, would have three times as many. Steps that do not iterate add the
             estimate of their error over the bound instead (body_state.excess)
round_robin  the object whose matrix was sent longest ago

Whatever the rule, an object whose last matrix is `overdue` goes first, so none starves.
"""

import ctypes as c
from math import ceil, inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.shared_memory.located import address
from sim_server.scene.solver_options import Rule
from sim_server.updates.update_table import COLUMNS, TEXT, Flags, UpdateRequests, addresses, library

RULES: dict[Rule, int] = {"excess": TEXT.enumerators["BY_EXCESS"], "round_robin": TEXT.enumerators["BY_WAITING"]}


def is_worthwhile(requests: UpdateRequests, threshold: float = 1.0) -> Flags:
    """True where a new factor is worth its time now (the policy `adaptive`).

    It is once the iterations lost to the factor in use have cost `threshold` times a factorization. Where they grow
    steadily with its age, by a in each step at a cost of c, that is the best there is: a factor of cost F each T steps
    makes F / T + a c T / 2 a step, least where a c T^2 / 2, what was lost, is F. A body without a factor, or with
    one to be tried out, does not wait. The two costs must be in the same unit here.
    """
    lost = requests.lost * requests.iteration_cost
    return (requests.age < 0) | requests.on_trial | (lost >= threshold * requests.factorization_cost)


def pick(
    requests: UpdateRequests,
    places: int,
    min_interval: int = 1,
    rule: Rule = "excess",
    overdue: float = inf,
) -> list[int]:
    """Returns the numbers of up to `places` bodies, the most urgent first.

    Bodies of which no matrix was sent yet come first; then those that waited `overdue` steps, longest first; then by
    the rule; among equals the one that waited longest, then by order. A body in flight is left out, and one whose
    last matrix was sent less than min_interval steps ago (twice as long after each failure).
    """
    places = min(max(places, 0), len(requests))
    if not places:
        return []
    if (native := requests.native) is None:
        columns: dict[str, NDArray[Any]] = {
            name: np.ascontiguousarray(getattr(requests, name), kind)
            for kind, names in COLUMNS.items()
            for name in names
        }
        native = addresses(columns)
    chosen = np.empty(places, np.int64)
    count = library().wf_pick(
        c.addressof(native), len(requests), places, min_interval, RULES[rule], overdue, address(chosen)
    )  # fmt: skip
    bodies: list[int] = chosen[:count].tolist()
    return bodies


def round_duration(latencies: float, jobs: float) -> float:
    """Returns the steps in which every body is served once; inf without workers.

    latencies: steps from matrix to factor, summed over all bodies
    jobs: that are on their way at a time, one at each worker at least; 0: there is no worker. Each ends after its
        latency, so that jobs / latency of them end in a step (Little 1961, A proof for the queuing formula L = λ W)
    """
    return latencies / jobs if jobs > 0 else inf


def overdue_after(rounds: float, latencies: float, jobs: float) -> float:
    """Returns the steps after which a body goes next whatever the rule: `rounds` rounds, inf without workers."""
    return rounds * round_duration(latencies, jobs)


def max_factor_age(overdue: float, latencies: float, longest: float, jobs: float) -> int:
    """Returns a bound on the age of any factor in steps, -1 without workers.

    A body waits until it is overdue and then behind all the others, and its matrix is copied, factorized and taken
    up while the factor before is still in use.

    longest: of the latencies
    """
    if jobs <= 0 or not latencies:
        return -1
    return ceil(overdue + round_duration(latencies, jobs) + 2 * longest + 2)
