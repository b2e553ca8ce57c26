# SPDX-License-Identifier: MIT
"""How much one core, one GPU, one worker and one link hold, from what the other pages measured."""

import time
from typing import Any

from precond_worker.network.pool import read_need
from precond_worker.network.pool_choice import PoolChoice, ServerNeed
from protocol.channels import PROTOCOL
from protocol.messages_pb2 import Header, Need
from sim_server.mesh import bar
from sim_server.service.need import PERIOD
from tests.bench.scale.measured import SIZES, body, dragged, row
from tests.bench.scale.simulate import CELLS, LINK, matrix_bytes

RATE = 50.0  # steps a second
MANY = {540: "512", 3000: "256"}  # bodies that gpu.md steps in the same launches


def of_cores() -> list[dict[str, Any]]:
    """Bodies that a core and a GPU hold at RATE; where p99 of a step is meant, nearly all steps are in time."""
    found = []
    for tets in SIZES:
        one, gpu = body(tets), row("gpu.md", tets=str(tets), material="homogeneous")
        many = row("gpu.md", beams=MANY[tets], tets=str(tets)) if tets in MANY else None
        found.append({
            "tets": tets, "a core, by p50": 1 / (RATE * one.step), "a core, by p99": 1 / (RATE * one.worst),
            "a GPU, one after another, by p50": 1e6 / (RATE * float(gpu["us p50"])),
            "a GPU, one after another, by p99": 1e6 / (RATE * float(gpu["us p99"])),
            "a GPU, in the same launches": float(many["beam steps/s"]) / RATE if many else None,
        })  # fmt: skip
    return found


def of_factors() -> list[dict[str, Any]]:
    """What a factor costs, and how many a worker on a core, on a GPU and a router's link manage."""
    found = []
    for tets in SIZES:
        one, gpu = body(tets), row("gpu.md", tets=str(tets), material="homogeneous")
        both = one.bytes + matrix_bytes(tets)
        found.append({
            "tets": tets, "matrix MB": 1e-6 * matrix_bytes(tets), "factor MB": 1e-6 * one.bytes,
            "factors/s of a worker on a core": 1 / one.factor,
            "factors/s of a worker on a GPU": 1e3 / float(gpu["factor ms"]) if "float" in gpu["library"] else None,
            "factors/s of a link": LINK / both, "workers on cores that fill a link": LINK / both * one.factor,
        })  # fmt: skip
    return found


def of_users(ages: tuple[float, ...] = (0.1, 1.0)) -> list[dict[str, Any]]:
    """What one user costs who drags a body of his own: cores of the loop and of workers, bytes, and who only watches.

    ages: of factors, on average [s]; half of it is the time between two.
    """
    found = []
    for tets in SIZES:
        one, motion = body(tets), dragged()
        nodes = len(bar(list(CELLS[tets]), [1.0, 1.0, 4.0]).rest)
        for age in ages:
            extra = motion.excess(age * RATE) * one.iteration
            factors = min(1 / age, 1 / one.factor, RATE)
            found.append({
                "tets": tets, "age of factors s": age, "cores of the loop": RATE * (one.cpu + extra),
                "cores of workers": factors * one.factor, "MB/s of matrices and factors":
                1e-6 * factors * (one.bytes + matrix_bytes(tets)), "MB/s to somebody who watches each step":
                1e-6 * RATE * nodes * 24.0,
            })  # fmt: skip
    return found


def least(times: int, call: Any) -> float:
    """Processor time of a call, least of so many [s]."""
    found = []
    for _ in range(times):
        start = time.thread_time()
        call()
        found.append(time.thread_time() - start)
    return min(found)


def of_choosing(counts: tuple[int, ...], times: int) -> list[dict[str, Any]]:
    """Measures what the choice itself costs a worker of a pool of so many servers: messages read, and one look."""
    data = Need(header=Header(protocol=PROTOCOL, incarnation=7, sequence=1), lost=0.01, workers=1.0).SerializeToString()
    reading = least(times, lambda: [read_need(data, {7}) for _ in range(100)]) / 100
    found = []
    for count in counts:
        needs = {f"s{k}": ServerNeed(0.01 * (k % 10 == 0), 0.1) for k in range(count)}
        chooser, moment = PoolChoice(1), iter(range(10**6))
        look = least(times, lambda c=chooser, n=needs, m=moment: c.update(n, PERIOD * next(m)))
        found.append({
            "servers of a pool": count, "messages/s to a worker": count / PERIOD, "us a message": 1e6 * reading,
            "ms a look": 1e3 * look, "% of a worker's core": 100 * (count * reading + look) / PERIOD,
        })  # fmt: skip
    return found
