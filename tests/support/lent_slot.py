# SPDX-License-Identifier: MIT
"""A slot of shared memory as a server lends it, without a network."""

import fcntl
import secrets
from typing import Self

import numpy as np

from protocol.messages_pb2 import Slot
from protocol.shared_memory.limits import SHM
from protocol.shared_memory.pool import HEADER


class LentSlot:
    """A segment with one slot, removed at the end of a context. data: its bytes. message: as a borrower gets it"""

    def __init__(self, size: int, generation: int = 1):
        self.path = SHM / f"{secrets.randbelow(10**18)}.zenoh"
        self._file = (made := self.path.with_suffix(".made")).open("w+b")
        self._memory = np.memmap(self._file, np.uint8, "w+", shape=(size + HEADER,))
        fcntl.flock(self._file, fcntl.LOCK_SH)  # processes with zenoh remove segments that nobody holds so
        made.rename(self.path)
        self.data = self._memory[HEADER:]
        self.message = Slot(segment=self.path.name, offset=HEADER, capacity=size, generation=generation)
        self.lend(generation)

    def lend(self, generation: int) -> None:
        """Begins a generation."""
        self._memory[:8].view(np.uint64)[0] = generation

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.path.unlink()
        self._file.close()
