# SPDX-License-Identifier: MIT
"""Opens the log that a command reads."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from protocol.log_pieces import size_of_log
from protocol.printable import printable

if TYPE_CHECKING:
    from clients.log.reader import Log


@contextlib.contextmanager
def opened_log(path: Path) -> Iterator[Log]:
    """Opens a log with a progress bar; prints what it lacks on stderr."""
    from clients.log.reader import Log
    from clients.progress import progress_bar

    with progress_bar("reading", size_of_log(path)) as progress:
        log = Log(path, progress)
    with log:
        for note in log.notes:
            print(f"sim-client: {printable(note)}", file=sys.stderr)
        yield log
