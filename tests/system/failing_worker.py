# SPDX-License-Identifier: MIT
"""A worker that lacks memory. Arguments: heartbeat|take_in|loading, where it fails, then those of precond-worker."""

import sys

from precond_worker.cli import main
from precond_worker.network.server_connection import ServerConnection
from precond_worker.worker import Worker

WHERE = sys.argv.pop(1)


def fail(error: BaseException):
    def instead(*_: object, **__: object) -> None:
        raise error

    return instead


def fail_once_served(say):
    def instead(self: ServerConnection) -> None:
        say(self)
        if self.incarnation:
            raise RuntimeError("can't start new thread")

    return instead


if WHERE == "heartbeat":
    ServerConnection._say = fail_once_served(ServerConnection._say)
elif WHERE == "take_in":
    Worker._choose_server = fail(MemoryError())
else:
    Worker._analysis = fail(ImportError("/lib/x.so: failed to map segment from shared object"))
main()
