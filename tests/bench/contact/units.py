# SPDX-License-Identifier: MIT
"""What bench contact measures, in parts that may run in any order and on any machine."""

from collections.abc import Iterator
from functools import partial

from tests.bench.contact import cost, few, known, ladder, passes, picture
from tests.bench.contact.bodies import SITUATIONS, TUMBLING, Row
from tests.bench.harness.units import Unit

KEYS = {  # what tells the rows of a table apart
    "answers": ("case",),
    "wall": ("cells",),
    "hertz": ("tets", "depth mm"),
    "belt": ("friction",),
    "paths": ("obstacle", "dt ms", "speed"),
    "passes": ("passes, at most",),
    "cost": ("tets", "kappa", "situation", "preconditioner"),
    "few": ("body", "nodes", "kappa", "lockstep", "preconditioner"),
    "impact": ("tets", "preconditioner"),
    "goals": ("situation", "bodies", "contacts"),
    "own": ("case",),
    "stairs": ("scene",),
}
SIZES = (540, 3000, 24_000)
KAPPAS = (1.0, 10.0, 100.0)


def units(sizes: tuple[int, ...], quick: bool) -> list[Unit]:
    """All of them."""
    return [*_answers(quick), *_paths(quick), *_passes(quick), *_cost(sizes, quick), *_others(quick)]


def _answers(quick: bool) -> Iterator[Unit]:
    names = ["rest", "turned"] if quick else list(ladder.CASES)
    for name in names:
        yield Unit("answers", name, 2, ladder.CASES[name])
    yield Unit("answers", "bar", 2, known.bar_answers)
    yield Unit("wall", "curve", 2, partial(known.wall, 20 if quick else 100))
    for cells in (4, 6) if quick else (12, 16, 24):
        yield Unit("hertz", f"{cells}", cells**3 / 200, partial(known.hertz, cells))
    for friction in (0.3,) if quick else (0.1, 0.2, 0.3, 0.5):
        yield Unit("belt", f"{friction:g}", 2, partial(_one, known.belt, friction))


def _paths(quick: bool) -> Iterator[Unit]:
    for name in list(ladder.OBSTACLES)[:2] if quick else ladder.OBSTACLES:
        for dt in ladder.TIME_STEPS[-1:] if quick else ladder.TIME_STEPS:
            for speed in ladder.SPEEDS[-1:] if quick else ladder.SPEEDS:
                measure = partial(_one, ladder.tunnelling, name, dt, speed)
                yield Unit("paths", f"{name}, {1e3 * dt:.3g} ms, {speed:g} m/s", 0.5, measure)


def _passes(quick: bool) -> Iterator[Unit]:
    for most in passes.AT_MOST[-1:] if quick else passes.AT_MOST:
        yield Unit("passes", f"{most}", 7, partial(_one, passes.row, most, 0.2 if quick else 1.0))


def _cost(sizes: tuple[int, ...], quick: bool) -> Iterator[Unit]:
    for tets in sizes:
        for kappa in KAPPAS[:1] if quick else KAPPAS:
            for situation in SITUATIONS:
                if tets > 3000 and kappa > 10 and situation is TUMBLING:
                    continue  # takes many minutes
                measure = partial(cost.rows, tets, kappa, situation, quick)
                yield Unit("cost", f"{tets}, kappa {kappa:g}, {situation.name}", tets / 800, measure)
    for name, tooled in [("beam", few.SMALL)] if quick else few.BODIES.items():
        for kappa, age in ((1.0, 3),) if quick else ((1.0, 3), (1.0, 20), (10.0, 3), (10.0, 20)):
            measure = partial(few.rows, tooled, kappa, age, 12 if quick else few.STEPS)
            yield Unit("few", f"{name}, kappa {kappa:g}, lockstep-{age}", 60 if name == "large slab" else 5, measure)
    yield Unit("impact", "curves", 3, partial(cost.impact_curves, min(3000, max(sizes))))


def _others(quick: bool) -> Iterator[Unit]:
    for contacts in (10,) if quick else (10, 100, 1000):
        yield Unit("goals", f"{contacts}", contacts / 30 + 3, partial(cost.goals, contacts, short=quick))
    yield Unit("own", "cost", 10, partial(cost.own_cost, 2 if quick else 30))
    yield Unit("stairs", "picture", 5, partial(picture.rows, 20 if quick else 180))


def _one(measure: object, *arguments: object) -> list[Row]:
    assert callable(measure)
    return [measure(*arguments)]
