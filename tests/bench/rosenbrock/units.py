# SPDX-License-Identifier: MIT
"""What bench rosenbrock measures, in parts that may run in any order and on any machine."""

from collections.abc import Iterator
from functools import partial

from tests.bench.harness.units import Unit
from tests.bench.rosenbrock import ages, conserved, precision, stability, times
from tests.bench.rosenbrock.bars import Bar

KEYS = {  # what tells the rows of a table apart
    "precision": ("device", "tets", "material", "E MPa", "method", "dt ms"),
    "ages": ("device", "matrix", "latency", "dt ms"),
    "stability": (
        "device",
        "varied",
        "start",
        "model",
        "E MPa",
        "Poisson",
        "dt ms",
        "latency",
        "tangent",
        "bound / edge",
    ),
    "undamped": ("device", "dt ms", "method"),
    "free": ("device", "dt ms", "method"),
    "times": ("device", "tets", "material", "method"),
    "limits": ("device", "case"),
}
SIZES = (540, 3000, 24_000)
STIFFNESSES = (1e5, 1e6, 1e7)  # Pa
SMALL = 540  # of all parts but precision and times


def units(device: str, sizes: tuple[int, ...], rounds: int, quick: bool) -> list[Unit]:
    """All of them."""
    return [
        *_precision(device, sizes, rounds, quick), *_ages(device, quick), *_stability(device, quick),
        *_conserved(device, quick), *_times(device, sizes, quick), *_limits(device, quick),
    ]  # fmt: skip


def _precision(device: str, sizes: tuple[int, ...], rounds: int, quick: bool) -> Iterator[Unit]:
    for tets in sizes:
        large = tets >= precision.LARGE
        seconds = 0.4 if quick else 0.8 if large else 2.0
        steps = (0.04, 0.02) if quick else precision.TIME_STEPS[:4] if large else precision.TIME_STEPS
        methods = (
            (precision.METHODS[0], precision.METHODS[-3], precision.OURS) if quick else precision.methods_for(tets)
        )
        for bands in (False, True):
            for young in (1e6,) if quick or large or (bands and tets > SMALL) else STIFFNESSES:
                bar = Bar(tets, young, bands=bands)
                name = f"{tets}, {bar.material}, {young / 1e6:g} MPa, {device}"
                measure = partial(precision.rows, bar, device, seconds, steps, methods, rounds)
                yield Unit("precision", name, 5 + tets / 150, measure)


def _ages(device: str, quick: bool) -> Iterator[Unit]:
    steps, latencies = ((0.02,), (1, 3)) if quick else (ages.TIME_STEPS, ages.LATENCIES)
    yield Unit(
        "ages", device, 40, partial(ages.rows, Bar(_size(quick)), device, 0.4 if quick else 4.0, steps, latencies)
    )


def _stability(device: str, quick: bool) -> Iterator[Unit]:
    for group, cases in stability.groups().items():
        if quick:
            cases = cases[:1]
        seconds = 0.4 if quick else stability.SECONDS
        measure = partial(stability.rows, group, cases, device, _size(quick), seconds)
        yield Unit("stability", f"{group}, {device}", 1.5 * len(cases), measure)


def _conserved(device: str, quick: bool) -> Iterator[Unit]:
    for dt in conserved.TIME_STEPS[-1:] if quick else conserved.TIME_STEPS:
        measure = partial(conserved.undamped, _size(quick), device, dt, 0.4 if quick else 30.0)
        yield Unit("undamped", f"{1e3 * dt:g} ms, {device}", 0.1 / dt, measure)
    for dt in conserved.FREE_TIME_STEPS[-1:] if quick else conserved.FREE_TIME_STEPS:
        measure = partial(conserved.free, _size(quick), device, dt, 0.4 if quick else 20.0)
        yield Unit("free", f"{1e3 * dt:g} ms, {device}", 0.2 / dt, measure)


def _times(device: str, sizes: tuple[int, ...], quick: bool) -> Iterator[Unit]:
    for tets in sizes:
        steps = 30 if quick else 50 if tets >= precision.LARGE else 100
        for bands in (False,) if quick else (False, True):
            bar = Bar(tets, bands=bands)
            name = f"{tets}, {bar.material}, {device}"
            yield Unit("times", name, tets / 800, partial(times.rows, bar, device, steps))


def _limits(device: str, quick: bool) -> Iterator[Unit]:
    for name in list(times.LIMITS)[:2] if quick else times.LIMITS:
        measure = partial(times.limits, name, device, 0.4 if quick else 2.0, _size(True) if quick else 0)
        yield Unit("limits", f"{name}, {device}", 4, measure)


def _size(quick: bool) -> int:
    return 162 if quick else SMALL
