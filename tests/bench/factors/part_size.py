# SPDX-License-Identifier: MIT
"""What a factor costs by the size of its parts: worker and server in one process, over TCP, with slots and as bytes.

Rounds with all sizes in turn; a row has the medians, for a GiB: time, and processor time of both sides together.
"""

import argparse
import json
import logging
import time
from collections.abc import Sequence
from statistics import median
from typing import Any

import numpy as np

from precond_worker.network.offered_factors import OfferedFactors
from protocol.channels import PROTOCOL
from protocol.counters import Counters
from protocol.messages_pb2 import Header
from protocol.network.session import Session, open_session
from protocol.shared_memory.pool import SlotPool, SlotsUnusable
from sim_server.network.factor_fetch import AHEAD, FactorFetch
from tests.ports import free_endpoint
from tests.support.in_flight import in_flight

SIZES = tuple(1 << k for k in range(20, 27))
COUNTERS = Counters(logging.getLogger(__name__))
Row = dict[str, Any]


def measured(sizes: Sequence[int], size: int, rounds: int) -> list[Row]:
    """Returns a row for each way and size of parts [bytes]. size: of the factor [bytes]"""
    where = [free_endpoint()]
    values = np.random.default_rng(0).standard_normal(size // 4, np.float32)
    times: dict[tuple[str, int], list[tuple[float, float]]] = {}
    with open_session("server", listen=where) as server, open_session("client", connect=where) as client:
        offered = OfferedFactors(client, "sim", "w", COUNTERS)
        for _ in range(rounds):
            for part_bytes in sizes:
                for way, pool in (("slots", _pool()), ("bytes", None)):
                    if way == "bytes" or pool is not None:
                        taken = _once(server, offered, values, part_bytes, pool)
                        times.setdefault((way, part_bytes), []).append(taken)
        offered.close()
    scale = 2**30 / size
    return [
        {"way": way, "part KiB": part >> 10, "s": scale * median(t[0] for t in all_of_them),
         "processor s": scale * median(t[1] for t in all_of_them), "rounds": rounds}
        for (way, part), all_of_them in sorted(times.items())
    ]  # fmt: skip


def _pool() -> SlotPool | None:
    try:
        return SlotPool()
    except SlotsUnusable:
        return None


def _once(
    server: Session, offered: OfferedFactors, values: Any, part_bytes: int, pool: SlotPool | None
) -> tuple[float, float]:
    """Returns time and processor time [s] of one factor, without the checksums that announce it."""
    parts = offered.offer("beam", Header(protocol=PROTOCOL, incarnation=1), 1, values, part_bytes)
    slots = [] if pool is None else [pool.lend(part_bytes) for _ in range(AHEAD)]
    job = in_flight(1, "beam", 1, 1, "float32", "w", 0.0, part_bytes=part_bytes)
    fetch = FactorFetch(server.zenoh, "sim", 1, COUNTERS, job, len(values), parts, [s for s in slots if s is not None])
    wall, cpu = time.perf_counter(), time.process_time()
    got = fetch.run()
    taken = time.perf_counter() - wall, time.process_time() - cpu
    if not np.array_equal(got, values):
        raise ValueError("another factor came than was sent")
    return taken


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--mib", type=int, default=256, help="of the factor")
    parser.add_argument("--rounds", type=int, default=5)
    o = parser.parse_args()
    for row in measured(SIZES, o.mib << 20, o.rounds):
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
