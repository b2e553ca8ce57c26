# SPDX-License-Identifier: MIT
"""What was aimed at, which figure tells whether it is met, and what bounds it."""

from dataclasses import dataclass
from typing import Any

SUBTREES = "bytes of L, read twice an iteration: what one core gets from memory, with many what all do"
PHASES = "latency: the phases of the partitioned inverse, each one or two trips through L2"
BYTES = "bytes of the partitioned inverse at the bandwidth of the memory, a fifth more between phases"
LINKS = "half of these bytes on each, and the levels at the top of the tree, whose vectors cross between them"
AGE = "iterations while the factor is too old for what happened"
MANY = "memory while all apply their inverses, latency in the rest of an iteration; and the assembly"
SMALL = "latency: each part of a solve is short, and one body at a time has a multiprocessor; and the assembly"
STAGES = "factorization and inverse, then the way between two processes"
RECORDS = "records of each body, which the loop's thread completes one after the other"
THREAD = "the thread that serves the loop: copies out, factors in, in Python"


@dataclass(frozen=True)
class Target:
    """where: what its row has; column: what is compared; at_least: whether more is better; was: what it was at d71f2f6
    on the machine on which the goal was set, None where nobody measured it there."""

    what: str
    where: dict[str, Any]
    goal: float | None
    unit: str
    bound: str
    column: str = "p50"
    at_least: bool = False
    was: float | None = None

    def gain(self, before: float | None, after: float | None) -> float | None:
        """How many times better one is than the other; None where one is missing."""
        if not before or not after:
            return None
        return after / before if self.at_least else before / after

    def goal_text(self) -> str:
        """The goal as the page shows it."""
        return "–" if self.goal is None else f"{'at least ' if self.at_least else ''}{self.goal:,g}"

    def met(self, value: float | None) -> str:
        """yes, no, or a dash where it was not measured or there is no goal."""
        if value is None or self.goal is None:
            return "–"
        return "yes" if (value >= self.goal if self.at_least else value <= self.goal) else "no"


def _threads(tets: int, goals: dict[int, tuple[float, float]]) -> list[Target]:
    return [
        Target(f"CPU, one body of {tets:,} tetrahedra, {n} thread{'s' if n > 1 else ''}",
               {"what": "threads", "tets": tets, "threads": n}, goal, "ms", SUBTREES, was=was)
        for n, (was, goal) in goals.items()
    ]  # fmt: skip


def _steps(
    what: str, tets: int, was: float | None, goal: float, bound: str, column: str = "p50", unit: str = "ms",
    **where: Any,
) -> Target:  # fmt: skip
    usual = {"what": "steps", "tets": tets, "material": "homogeneous", "beams": 1}
    return Target(what, usual | where, goal, unit, bound, column, was=was)


def _large(tets: int, was: float, goal: float) -> list[Target]:
    one, two = f"GPU, {tets:,} tetrahedra", "the same on two GPUs"
    return [_steps(one, tets, was, goal, BYTES), _steps(two, tets, None, goal, LINKS, settings="solver.gpus=2")]


def _sofa(tets: int, figure: float) -> Target:
    return Target(
        f"CPU, SOFA's beam of {tets:,} with a worker; goal: SOFA's own",
        {"what": "sofa", "tets": tets},
        figure,
        "CPU ms",
        "assembly, and one to two iterations",
    )


def _real_time(
    what: str, tets: int, column: str, was: float | None, goal: float, unit: str, bound: str
) -> Target:  # fmt: skip
    return Target(what, {"what": "real_time", "tets": tets}, goal, unit, bound, column, was=was)


def _many(
    what: str, kind: str, beams: int, column: str, was: float | None, goal: float, unit: str
) -> Target:  # fmt: skip
    where = {"what": kind, "tets": 540, "beams": beams}
    return Target(what, where, goal, unit, THREAD, column, unit == "1/s", was)


TARGETS = (
    *_threads(24_000, {1: (19.8, 19), 2: (15, 10), 4: (15.8, 5.5), 8: (16.6, 3.5), 12: (17.5, 3)}),
    *_threads(98_304, {1: (188, 180), 2: (151, 95), 4: (158, 50), 8: (146, 28), 12: (124, 22)}),
    _real_time("GPU server, 98,304, real time: first factor in use", 98_304, "in use s", 7.0, 1.0, "s", STAGES),
    _real_time("the same: longest answer to a status query", 98_304, "answer ms max", None, 50, "ms", "Python's lock"),
    _real_time("the same: matrix to factor in use, median", 98_304, "in use after ms", 260, 120, "ms", STAGES),
    _real_time(
        "GPU server, 24,000, real time: step with the first factor", 24_000, "in use step", 25, 5, "steps", STAGES
    ),
    _real_time("the same: age of factors, mean", 24_000, "factor age", 3.9, 2, "steps of 30 ms", STAGES),
    _many("factors a second, 512 bodies of 540, one GPU worker", "many", 512, "factors/s", 150, 5000, "1/s"),
    _many("the same, 1,024 bodies", "many", 1024, "factors/s", 150, 5000, "1/s"),
    _many("factors a second, 512 bodies that keep swinging", "swinging", 512, "factors/s", 150, 5000, "1/s"),
    _many("the same, 1,024 bodies", "swinging", 1024, "factors/s", 150, 5000, "1/s"),
    _many("the same: age of factors, mean", "swinging", 1024, "factor age", 958, 50, "steps"),
    _steps("host time of a step, 1,024 bodies of 540", 540, 360, 40, RECORDS, "host us", "us", beams=1024),
    _steps("GPU, 256 bodies of 3,000", 3000, 2.24, 1.6, MANY, beams=256),
    _steps("GPU, 512 bodies of 540", 540, 0.81, 0.6, SMALL, beams=512),
    _steps("GPU, 24,000 tetrahedra", 24_000, None, 0.16, PHASES),
    _steps("GPU, 24,000, heterogeneous: p99", 24_000, 2.6, 1.2, AGE, "p99", material="heterogeneous"),
    _steps("GPU, 98,304 tetrahedra", 98_304, None, 0.55, BYTES),
    *_large(405_600, 3.56, 2.9),
    *_large(1_029_000, 20.8, 13),
    *(_sofa(tets, figure) for tets, figure in {540: 1.1, 3000: 5.95, 7350: 29.4, 24_000: 134.0}.items()),
    Target("GPU, a step of 3,000 to 2e-3 of the length; goal: Newton's VBD (300 iterations)", {"what": "motion"}, 11.4,
           "ms", "two linearizations: forces, a fetch of A and of the factor each"),
)  # fmt: skip
