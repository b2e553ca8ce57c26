# SPDX-License-Identifier: MIT
"""Getting to the server, however long it takes."""

import sys
from collections.abc import Sequence

from protocol.session import ConnectionFailed, Session, open_session


def join(connect: Sequence[str], shared_memory: bool) -> Session:
    """A session to the server; while it is not there yet this says so once and tries on. Raises BadEndpoint."""
    said = False
    while True:
        try:
            return open_session("client", connect=connect, shared_memory=shared_memory, timeout=1.0)
        except ConnectionFailed as failure:
            if not said:
                print(f"precond-worker: {failure}; trying until the server is there", file=sys.stderr, flush=True)
            said = True
