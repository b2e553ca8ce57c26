# SPDX-License-Identifier: MIT
"""Whose matrix goes next, and what a solve adds to its object's sum: tables of pure functions."""

import pytest

from sim_server.schedule import Need, excess, pick

NEW, BUSY = None, True


def needs(*rows: tuple) -> list[Need]:
    """Rows (object, excess, waited, in flight)."""
    return [Need(*row) for row in rows]


@pytest.mark.parametrize(
    ("iterations", "floor", "expected"), [(0, 3, 0), (3, 3, 0), (4, 3, 1), (100, 3, 97), (5, 0, 5), (2, 10, 0)]
)
def test_excess(iterations, floor, expected):
    assert excess(iterations, floor) == expected


TABLE = {
    "nothing": ([], 1, 1, []),
    "one": ([("a", 0, 5, False)], 1, 1, ["a"]),
    "no place": ([("a", 9, 5, False)], 0, 1, []),
    "a negative number of places": ([("a", 9, 5, False)], -1, 1, []),
    "largest excess": ([("a", 1, 5, False), ("b", 3, 5, False), ("c", 2, 5, False)], 1, 1, ["b"]),
    "two places": ([("a", 1, 5, False), ("b", 3, 5, False), ("c", 2, 5, False)], 2, 1, ["b", "c"]),
    "more places than objects": ([("a", 1, 5, False), ("b", 3, 5, False)], 7, 1, ["b", "a"]),
    "without a factor first": ([("a", 99, 50, False), ("b", 0, NEW, False)], 2, 1, ["b", "a"]),
    "both without, by excess": ([("a", 1, NEW, False), ("b", 2, NEW, False)], 2, 1, ["b", "a"]),
    "in flight is left out": ([("a", 9, 5, BUSY), ("b", 1, 5, False)], 2, 1, ["b"]),
    "in flight without a factor": ([("a", 9, NEW, BUSY)], 1, 1, []),
    "floor of steps": ([("a", 9, 3, False), ("b", 1, 4, False)], 2, 4, ["b"]),
    "floor of steps does not hold back the first": ([("a", 0, NEW, False)], 1, 100, ["a"]),
    "equal excess, who waited longer": ([("a", 2, 5, False), ("b", 2, 9, False)], 1, 1, ["b"]),
    "all equal, in order": ([("a", 2, 5, False), ("b", 2, 5, False)], 2, 1, ["a", "b"]),
    "no excess at all, who waited longer": ([("a", 0, 1, False), ("b", 0, 30, False)], 1, 1, ["b"]),
}


@pytest.mark.parametrize(("rows", "places", "floor", "expected"), TABLE.values(), ids=TABLE.keys())
def test_pick(rows, places, floor, expected):
    assert pick(needs(*rows), places, floor) == expected


def test_everybody_gets_a_turn():
    """With equal needs a single place goes round: whoever was sent has waited least."""
    waited: dict[str, int | None] = dict.fromkeys("abc")
    order = []
    for _ in range(9):
        chosen = pick(needs(*((name, 1.0, w, False) for name, w in waited.items())), 1)[0]
        order.append(chosen)
        waited = {name: None if w is None else w + 1 for name, w in waited.items()}
        waited[chosen] = 1
    assert "".join(order) == "abcabcabc"


def test_the_busy_do_not_starve_the_calm():
    """The rule of the paper goes by excess alone; a calm object comes as soon as its sum is the largest."""
    sums, order = {"shaken": 0.0, "calm": 0.0}, []
    for _ in range(60):
        sums["shaken"] += 20
        sums["calm"] += 1
        chosen = pick(needs(*((name, s, 5, False) for name, s in sums.items())), 1)[0]
        sums[chosen] = 0
        order.append(chosen)
    assert order.count("calm") == 2
