# SPDX-License-Identifier: MIT
"""Service times that other benchmarks measured, read from their pages: nothing here is typed in."""

import re
from dataclasses import dataclass
from functools import cache

from tests.docs.figures import DOCS, BadMark, Row, table_under

SIZES = (540, 3000, 7350, 24000)  # tets of the bodies that all pages have
HANDS = {"objects": "4", "wild": "1"}  # few enough that a worker for each is the best there is


@dataclass(frozen=True)
class Body:
    """A body of one size.

    step, worst: wall time of a step with a factor, p50 and p99 [s]
    cpu: processor time of a step, median [s]
    iteration: time of one iteration [s]
    factor: processor time of a complete factor in float32 [s]
    analysis: time of its order and pattern, once for each topology [s]
    bytes: of the values of a factor in float32
    """

    tets: int
    step: float
    worst: float
    cpu: float
    iteration: float
    factor: float
    analysis: float
    bytes: int


@dataclass(frozen=True)
class Motion:
    """How iterations grow with the age of a factor.

    slope: iterations for each step of age
    most: iterations at the end
    """

    slope: float
    most: float

    def excess(self, age: float) -> float:
        """Returns the iterations above those with a fresh factor. age: in steps"""
        return min(self.slope * max(age, 0.0), self.most)


@cache
def tables(page: str) -> tuple[tuple[Row, ...], ...]:
    """All tables of a page of docs/bench."""
    blocks = re.findall(r"(?:^\|.*\n)+", (DOCS / "bench" / page).read_text(), re.MULTILINE)
    return tuple(tuple(table_under(f"# table\n{block}", "table")) for block in blocks)


def row(page: str, **wanted: str) -> Row:
    """The first row of a page that has these cells. Raises BadMark if there is none."""
    for table in tables(page):
        for found in table:
            if wanted.items() <= found.items():
                return found
    raise BadMark(f"no row of {page} with {wanted}")


def body(tets: int) -> Body:
    """What a core needs for a body: cpu.md (async + warp) and factors.md (supernodal, float32)."""
    step = row("cpu.md", tets=str(tets), scheme="async + warp")
    factor = row("factors.md", tets=str(tets), library="supernodal", **{"L in": "float32"})
    return Body(
        tets, 1e-3 * float(step["wall p50"]), 1e-3 * float(step["wall p99"]), 1e-3 * float(step["CPU ms"]),
        1e-3 * float(step["solve"]) / float(step["iterations"]), 1e-3 * float(factor["CPU ms"]),
        float(factor["symbolic s"]), 4 * int(factor["values of L"]),
    )  # fmt: skip


def of_hands(rule: str, workers: str) -> Row:
    """A row of scheduler.md. With few objects a worker for each is the best there is."""
    return row("scheduler.md", objects="4", wild="1", workers=workers, rule=rule)


def dragged() -> Motion:
    """A body in a hand: from scheduler.md, the object that is dragged about, with its springs in the correction.

    The slope lies between the ages under as many workers as objects and under one for all in turn; the end is that
    without updates.
    """
    new, old = (of_hands("round_robin, grabs corrected", workers) for workers in ("4", "1"))
    needed = float(old["wild, mean"]) - float(new["wild, mean"])
    slope = needed / (float(old["age, mean"]) - float(new["age, mean"]))
    return Motion(slope, float(of_hands("no updates", "–")["wild, mean"]) - 1.0)


def resting() -> Motion:
    """A body that trembles: from scheduler.md, the others, without updates; their iterations at twice the mean age."""
    never = of_hands("no updates", "–")
    more = float(never["rest, mean"]) - 1.0
    return Motion(more / float(never["age, mean"]), 2 * more)
