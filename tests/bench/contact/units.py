# SPDX-License-Identifier: MIT
"""What bench contact measures, in parts that may run in any order and on any machine."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from tests.bench.contact import agreement, cost, few, impact, itself, known, ladder, pairs, passes, peers, picture, pile
from tests.bench.contact.bodies import SITUATIONS, TUMBLING, Row
from tests.bench.harness.pieces import say
from tests.bench.harness.units import Unit

KEYS = {  # what tells the rows of a table apart
    "answers": ("case",),
    "wall": ("cells",),
    "hertz": ("tets", "depth mm"),
    "belt": ("friction",),
    "paths": ("obstacle", "dt ms", "speed"),
    "passes": ("passes, at most",),
    "cost": ("device", "tets", "kappa", "situation", "preconditioner"),
    "few": ("device", "body", "nodes", "contacts", "kappa", "lockstep", "preconditioner"),
    "impact": ("device", "tets", "preconditioner"),
    "goals": ("device", "situation", "bodies", "contacts"),
    "own": ("device", "case"),
    "itself": ("case",),
    "pile": ("device", "bodies"),
    "peers": ("device", "case", "who", "settings"),
    "stairs": ("scene",),
}
SIZES = (540, 3000, 24_000)
KAPPAS = (1.0, 10.0, 100.0)
ENERGY = 30  # weight of a run of 1e4 steps
SECONDS = {"MuJoCo": 10, "Newton VBD": 40}  # weight of a case of others, by bodies
CASES: dict[str, tuple[float, Callable[[], list[Row]]]] = {
    **{name: (ENERGY if name == "energies" else 2, case) for name, case in ladder.CASES.items()},
    "collisions": (2, pairs.collisions), "stacks": (10, pairs.stacks), "replays": (20, agreement.replays),
    "itself": (5, itself.answers),
}  # fmt: skip


def units(device: str, sizes: tuple[int, ...], quick: bool, python: Path | None) -> list[Unit]:
    """All of a device. python: one that has the peers."""
    there = [*_few(device, quick), *_cost(device, sizes, quick), *_others(device, quick),
             *_peers(device, quick, python)]  # fmt: skip
    if device == "gpu":
        replays = partial(agreement.replays, "gpu")
        return [
            Unit("answers", "gpu", 10, agreement.devices), Unit("answers", "stacks, gpu", 5, agreement.stacks),
            Unit("answers", "replays, gpu", 20, replays), *there,
        ]  # fmt: skip
    return [*_answers(quick), *_paths(quick), *_passes(quick), *there]


def _answers(quick: bool) -> Iterator[Unit]:
    for name in ("rest", "turned", "collisions") if quick else CASES:
        yield Unit("answers", name, *CASES[name])
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


def _few(device: str, quick: bool) -> Iterator[Unit]:
    for hand in few.HANDS[1:2] if quick else few.HANDS:
        for age in (2,) if quick else (3, 20):
            measure = partial(few.hand_rows, hand, age, few.SMALL.cells if quick else few.HELD, device)
            name = f"hand, {hand.nodes} nodes, {hand.stiffness:g} blocks, lockstep-{age}, {device}"
            yield Unit("few", name, 2, measure)
    for name, tooled in [("beam", few.SMALL)] if quick else few.BODIES.items():
        for kappa, age in ((1.0, 3),) if quick else ((1.0, 3), (1.0, 20), (10.0, 3), (10.0, 20)):
            measure = partial(few.rows, tooled, kappa, age, 12 if quick else few.STEPS, device)
            weight = 60 if name == "large slab" else 5
            yield Unit("few", f"{name}, kappa {kappa:g}, lockstep-{age}, {device}", weight, measure)


def _cost(device: str, sizes: tuple[int, ...], quick: bool) -> Iterator[Unit]:
    for tets in sizes:
        for kappa in KAPPAS[:1] if quick else KAPPAS:
            for situation in SITUATIONS:
                if tets > 3000 and kappa > 10 and situation is TUMBLING:
                    continue  # takes many minutes
                measure = partial(cost.rows, tets, kappa, situation, quick, device)
                yield Unit("cost", f"{tets}, kappa {kappa:g}, {situation.name}, {device}", tets / 800, measure)
    for tets in [tets for tets in sizes if tets >= 3000] or sizes[:1]:
        measure = partial(impact.curves, tets, device, 40 if quick else impact.STEPS)
        yield Unit("impact", f"{tets}, {device}", tets / 300, measure)


def _others(device: str, quick: bool) -> Iterator[Unit]:
    for contacts in (10,) if quick else (10, 100, 1000):
        measure = partial(cost.goals, contacts, short=quick, device=device)
        yield Unit("goals", f"{contacts}, {device}", contacts / 30 + 3, measure)
    yield Unit("own", f"cost, {device}", 10, partial(cost.own_cost, 2 if quick else 30, device=device))
    for bodies in (2,) if quick else pile.COUNTS:
        yield Unit("pile", f"{bodies}, {device}", 1.5 * bodies, partial(_one, pile.row, bodies, device, quick))
    if device == "cpu":
        yield Unit("itself", "cost", 10, partial(itself.cost, 2 if quick else 30))
        yield Unit("stairs", "picture", 5, partial(picture.rows, 20 if quick else 180))


def _peers(device: str, quick: bool, python: Path | None) -> Iterator[Unit]:
    """Ours, and those that the other Python has; of the rest it is said that they are left out."""
    out = {}
    for way in peers.WAYS[:1] if quick else peers.WAYS:
        if device == "gpu" and not way.on_gpu:
            continue
        if way.module and way.who not in out:
            out[way.who] = peers.missing(python, way.module)
        if out.get(way.who):
            continue
        for case in peers.CASES[:1] if quick else peers.CASES:
            measure = partial(_one, peers.row, case, way, device, str(python))
            seconds = case.bodies * SECONDS.get(way.who, 1)
            yield Unit("peers", f"{way.who}, {way.name}, {case.name}, {device}", seconds, measure)
    for who, why in out.items():
        if why:
            say(f"peers {who}: left out, {why}")


def _one(measure: object, *arguments: object) -> list[Row]:
    assert callable(measure)
    return [measure(*arguments)]
