# SPDX-License-Identifier: MIT
"""What bench accuracy measures, in parts that may run in any order and on any machine."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from tests.bench.accuracy import axes, effectivity, peers, points, sources
from tests.bench.accuracy.cases import CASES, ROLLERS, SMALL, Case
from tests.bench.harness.pieces import Row, say
from tests.bench.harness.units import Unit

KEYS = {  # what tells the rows of a table apart
    "points": ("device", "scene", "axis", "series", "value"),
    "sources": ("scene", "source"),
    "meshes": ("scene", "cells across"),
    "effectivity": ("device", "scene", "way", "estimate"),
    "peers": ("device", "who", "E MPa", "series", "value"),
}
WEIGHTS = {axes.STEPS: 40, axes.SCHEME: 120, "tolerance, preconditioner": 60}  # seconds, of an axis of a beam
SECONDS = {"MuJoCo": 5, "Newton": 15, "PyBullet": 10}  # weight of a point of others


def units(device: str, rounds: int, quick: bool, python: Path | None) -> list[Unit]:
    """All of a device. python: one that has the peers."""
    cases = (SMALL,) if quick else CASES
    found = [unit for case in cases for unit in _points(case, device, rounds, quick)]
    if device == "cpu":
        found += [Unit("sources", case.name, 90, partial(sources.rows, case)) for case in cases]
        cells = sources.CELLS[:3] if quick else sources.CELLS
        plane = sources.PLANE_CELLS[:3] if quick else sources.PLANE_CELLS
        found.append(Unit("meshes", ROLLERS.name, 60, partial(sources.of_meshes, ROLLERS, plane)))
        explicit = [case for case in cases if case.explicit]
        found += [Unit("meshes", case.name, 100, partial(sources.of_meshes, case, cells)) for case in explicit]
    for case in cases:
        for name, way in list(effectivity.ways(case, device).items())[: 1 if quick else None]:
            measure = partial(effectivity.rows, case, name, way, device)
            found.append(Unit("effectivity", f"{case.name}, {name}, {device}", 20, measure))
    return found if quick else [*found, *_peers(device, rounds, python)]


def _points(case: Case, device: str, rounds: int, quick: bool) -> Iterator[Unit]:
    for axis, several in axes.points(case, device, quick).items():
        measure = partial(points.rows, case, several, device, rounds)
        yield Unit("points", f"{case.name}, {axis}, {device}", WEIGHTS.get(axis, 30) * rounds, measure)
    if case.explicit and not quick:
        measure = partial(points.of_meshes, case, device, rounds)
        yield Unit("points", f"{case.name}, {axes.MESH}, {device}", 100, measure)


def _peers(device: str, rounds: int, python: Path | None) -> Iterator[Unit]:
    """Ours, SciPy's step, and those that the other Python has; of the rest it is said that they are left out."""
    for young in peers.STIFFNESSES:
        name = f"{young / 1e6:g} MPa, {device}"
        yield Unit("peers", f"ours, {name}", 30 * rounds, partial(peers.our_rows, young, device, rounds))
        for way in peers.ways(young):
            if (device == "cpu" or way.on_gpu) and not peers.missing(python, way.module):
                measure = partial(_one, peers.row, way, device, str(python))
                yield Unit("peers", f"{way.who}, {way.series}, {way.value}, {name}", SECONDS[way.who], measure)
    for dt in peers.SCIPY_STEPS if device == "cpu" else ():
        yield Unit("peers", f"SciPy, {1e3 * dt:g} ms", 5, partial(_one, peers.scipy_row, dt))
    for who, module in peers.MODULES.items():
        if why := peers.missing(python, module):
            say(f"peers {who}: left out, {why}")


def _one(measure: Callable[..., Row], *arguments: object) -> list[Row]:
    return [measure(*arguments)]
