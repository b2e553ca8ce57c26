# SPDX-License-Identifier: MIT
"""A worker process that factorizes densely. Arguments: endpoint, name, then any of no-shm, slow=SECONDS."""

import logging
import sys
import time

from link_helpers import DenseAnalysis

from precond_worker.network.connect import connect_session
from precond_worker.network.server_connection import ServerConnection
from precond_worker.worker import Worker
from protocol.counters import Counters


class SlowAnalysis(DenseAnalysis):
    seconds = 0.0

    def factorize(self, values, dtype):
        time.sleep(self.seconds)
        return super().factorize(values, dtype)


def main() -> None:
    endpoint, name, *options = sys.argv[1:]
    for option in options:
        if option.startswith("slow="):
            SlowAnalysis.seconds = float(option[5:])
    logging.basicConfig(level=logging.WARNING)
    with (
        connect_session([endpoint], "no-shm" not in options) as session,
        ServerConnection(session, "sim", name, 1, "dense", Counters(logging.getLogger("worker"))) as connection,
    ):
        Worker(connection, SlowAnalysis, lambda found: print("ready" if found else "gone", flush=True)).run()


if __name__ == "__main__":
    main()
