# SPDX-License-Identifier: MIT
"""A worker process that opens device memory, for which shared memory of the host stands. Arguments: endpoint, name,
servers with commas between them, then any of

closed: opens nothing but the probe
blind: opens nothing
remedy: has each matrix come to the host first
hangs: writes half of a factor, says so and waits
"""

import logging
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np
from link_helpers import DenseAnalysis

from precond_worker.network.connect import connect_session
from precond_worker.network.server_connection import ServerConnection
from precond_worker.round_robin import RoundRobin
from precond_worker.worker import Worker
from protocol.counters import Counters
from protocol.messages_pb2 import DeviceSlot
from protocol.refused import Refused
from tests.support.device_memory import OpenedStandIn, numbers

ENDPOINT, NAME, SERVERS, *OPTIONS = sys.argv[1:]


class Opened(OpenedStandIn):
    def address(self, slot: DeviceSlot, size: int) -> int:
        if "blind" in OPTIONS or ("closed" in OPTIONS and self._opened and slot.handle not in self._opened):
            raise Refused("no device memory here", "slot")
        return super().address(slot, size)


class DeviceAnalysis(DenseAnalysis):
    def factorize_on_device(self, matrix: int, dtype: Any) -> Callable[[int], None] | None:
        if "remedy" in OPTIONS:
            return None
        blocks = len(np.frombuffer(self._topology.columns, np.int32))
        values = self.factorize(numbers(matrix, np.float64, 9 * blocks).reshape(-1, 3, 3), dtype)

        def copy(to: int) -> None:
            half = len(values) // 2 if "hangs" in OPTIONS else len(values)
            numbers(to, dtype, len(values))[:half] = values[:half]
            if "hangs" in OPTIONS:
                print("half", flush=True)
                time.sleep(1000)

        return copy


def main() -> None:
    logging.basicConfig(level=logging.WARNING)
    with ExitStack() as closing:
        session = closing.enter_context(connect_session([ENDPOINT], True))
        turns = RoundRobin(threading.Event())
        for server in SERVERS.split(","):
            counters = Counters(logging.getLogger("worker"))
            connection = ServerConnection(session, server, NAME, 1, "dense", counters, turns.wake, Opened())
            closing.enter_context(connection)
            turns.add(Worker(connection, DeviceAnalysis, lambda found: print("ready" if found else "gone", flush=True)))
        while True:
            turns.step(1.0)


if __name__ == "__main__":
    main()
