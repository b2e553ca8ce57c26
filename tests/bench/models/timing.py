# SPDX-License-Identifier: MIT
"""Times of the models' launches on a CPU and on a GPU, and of MJED beside derivatives of 9x9 numbers."""

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tests.bench.gpu.problem import BARS
from tests.bench.harness.report import best_of
from tests.bench.models.parts import PARTS, Model, megabytes, model, part, states

TEXTS = "../tests/bench/models/"  # from the package, where kernel texts are looked up
LAWS = ("neo_hookean", "st_venant_kirchhoff")  # measured against 9x9
GENERIC = {"six edges": "elements", "all blocks": "all_blocks"}  # and their kernels

Row = dict[str, Any]


def copy_speed(megabytes: int = 256) -> float:
    """GB/s, read and written, of a copy on one thread."""
    source = np.ones(megabytes << 17)
    target = np.empty_like(source)
    return 2 * source.nbytes / best_of(5, lambda: np.copyto(target, source)) / 1e9


def on_cpu(calls: Sequence[Callable[[], Any]], seconds: float) -> list[float]:
    """us of each by the thread's own clock: medians of as many rounds, all in turn, as fit into so many seconds."""
    times: list[list[float]] = [[] for _ in calls]
    for call in calls:
        call()
    end = time.perf_counter() + seconds
    while len(times[0]) < 3 or time.perf_counter() < end:
        for call, found in zip(calls, times, strict=True):
            start = time.thread_time_ns()
            call()
            found.append(1e-3 * (time.thread_time_ns() - start))
    return [float(np.median(found)) for found in times]


def on_gpu(calls: Sequence[Callable[[], Any]], seconds: float) -> list[float]:
    """us of each among its like in a graph, the least of three."""
    from tests.bench.gpu.device import timed, timed_in_graph

    counts = [max(3, min(200, int(1e6 * seconds / len(calls) / timed(call, 3)))) for call in calls]
    rounds = [[timed_in_graph(call, n) for call, n in zip(calls, counts, strict=True)] for _ in range(3)]
    return [min(found) for found in zip(*rounds, strict=True)]


def row(name: str, tets: int, device: str, precision: str, seconds: float) -> Row:
    """One model at one size. CPU: each kernel by itself, on one thread; GPU: as they are put together there."""
    made = model(name, tets, device, precision)
    clock, kernels = (on_gpu, _fused(made.launches)) if device == "gpu" else (on_cpu, _by_part(made.launches))
    shapes = states(made.simulation.world.rest, BARS[tets][0])
    made.put(*shapes["bent"])
    every = [(p, kernel) for p in PARTS for kernel in kernels[p]]
    found = clock([kernel for _, kernel in every], 0.8 * seconds)
    us = {p: sum(t for (q, _), t in zip(every, found, strict=True) if q == p) for p in PARTS}
    made.put(*shapes["stretched"])
    stretched = sum(clock(kernels["elements"], 0.2 * seconds))
    return {
        "tets": tets, "model": name, "device": device, "precision": precision, "us": sum(us.values()),
        **{f"{p} us": value for p, value in us.items()}, "elements us, stretched": stretched,
        "MB": sum(megabytes(kernel) for several in kernels.values() for kernel in several),
    }  # fmt: skip


def _by_part(launches: Sequence[Any]) -> dict[str, list[Any]]:
    return {p: [x for x in launches if part(x) == p] for p in PARTS}


def _fused(launches: Sequence[Any]) -> dict[str, list[Any]]:
    """Those of nodes and of blocks, whatever parts they have, count as sums."""
    from sim_server.backends.gpu.kernel_fusion import fuse

    kernels: dict[str, list[Any]] = {p: [] for p in PARTS}
    for kernel in fuse(launches):
        kernels["elements" if part(kernel._launches[0]) == "elements" else "sums"].append(kernel)
    return kernels


def generic_row(law: str, tets: int, device: str, precision: str, seconds: float) -> Row:
    """The elements' kernel of a law by MJED and by 9x9, without a projection, stretched."""
    made = model(law, tets, device, precision, projection="none")
    made.put(*states(made.simulation.world.rest, BARS[tets][0])["stretched"])
    ours = next(x for x in made.launches if part(x) == "elements")
    others = {kind: generic(made, kernel) for kind, kernel in GENERIC.items()}
    clock = on_gpu if device == "gpu" else on_cpu
    us = dict(zip(("MJED", *others), clock([ours, *others.values()], seconds), strict=True))
    row: Row = {"tets": tets, "law": law, "device": device, "precision": precision, "MJED us": us["MJED"]}
    for kind in GENERIC:
        row |= {f"9x9, {kind} us": us[kind], f"{kind} / MJED": us[kind] / us["MJED"]}
        row[f"difference, {kind}"] = difference(ours, others[kind])
    return row


def generic(made: Model, kernel: str) -> Any:
    """The launch of the yardstick for the elements of a model, with arrays of its own for what it leaves."""
    e: Any = made.effect
    w = made.simulation.world
    module = w.backend.module(f"{TEXTS}generic_elements.cu+{TEXTS}generic_{made.name}.cuh")
    return module.bind(
        kernel, len(e.elements), tets=e.elements, x=w.x, v=w.damping_velocity, gradients=e.gradients, volume=e.volume,
        constants=e.constants, stiffness_coefficient=w.stiffness_coefficient(e.owner), h=w.force_coefficient,
        corners=np.zeros_like(e.corners),
        edges=np.zeros_like(e.edges),
    )  # fmt: skip


def difference(one: Any, other: Any) -> float:
    """Of what two launches leave, over the largest number."""
    one()
    other()
    worst = 0.0
    for name in ("corners", "edges"):
        a, b = one.fetch(name).astype(float), other.fetch(name).astype(float)
        worst = max(worst, float(np.abs(a - b).max() / np.abs(a).max()))
    return worst
