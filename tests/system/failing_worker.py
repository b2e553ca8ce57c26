# SPDX-License-Identifier: MIT
"""A worker that lacks memory. Arguments: heartbeat|take_in|loading, where it fails, then those of precond-worker."""

import sys
from collections.abc import Callable

from precond_worker.factorization import registry
from precond_worker.network import server_connection
from precond_worker.worker import Worker

WHERE = sys.argv.pop(1)


def fail(error: BaseException) -> Callable[..., None]:
    def instead(*_: object, **__: object) -> None:
        raise error

    return instead


class FailingHeartbeat(server_connection.Heartbeat):
    """Fails at the first beat after a server was chosen."""

    def __init__(self, beat: Callable[[], None]):
        def failing() -> None:
            beat()
            if beat.__self__.incarnation:  # type: ignore[attr-defined]
                raise RuntimeError("can't start new thread")

        super().__init__(failing)


if WHERE == "heartbeat":
    server_connection.Heartbeat = FailingHeartbeat  # type: ignore[misc]
elif WHERE == "take_in":
    Worker.take_in = fail(MemoryError())  # type: ignore[method-assign]
else:
    registry.make_factorization = fail(ImportError("/lib/x.so: failed to map segment from shared object"))

from precond_worker.cli import main  # noqa: E402

main()
