# SPDX-License-Identifier: MIT
"""The values of a factor whose parts come one by one, in any order. Has no sockets: parts are passed in."""

import numpy as np

from protocol.network.factor_parts import Bytes, bytes_of, part, part_count
from protocol.process.memory import available_memory
from protocol.refused import Refused
from protocol.validate import checksum


class ArrivingFactor:
    """Takes memory once, for all values; each part is copied to its place, and counts if it has the checksum that was
    announced for it there. So nothing else than what the worker computed can complete it.

    values: (nonzeros,) of the type, not to be read before `complete`
    """

    def __init__(self, nonzeros: int, dtype: str, part_bytes: int, checksums: list[int]):
        """nonzeros: of the pattern, which was checked. Raises Refused before memory is taken."""
        size = nonzeros * np.dtype(dtype).itemsize
        count = part_count(size, part_bytes)
        if len(checksums) != count:
            raise Refused(f"Factor.parts has {len(checksums)} entries; allowed: {count} of {part_bytes} bytes", "shape")
        available = available_memory()
        if available is not None and size > available:
            raise Refused(f"Factor of {size} bytes: only {available} bytes of memory are available", "memory")
        try:
            self.values = np.empty(nonzeros, dtype)
        except MemoryError as error:
            raise Refused(f"Factor of {size} bytes: no memory", "memory") from error
        self._data, self._part_bytes, self._checksums = bytes_of(self.values), part_bytes, checksums
        self.missing = set(range(count))

    @property
    def complete(self) -> bool:
        """True once all parts are there."""
        return not self.missing

    def bytes_of_part(self, number: int) -> int:
        """Returns the size of a part."""
        return len(part(self._data, number, self._part_bytes))

    def take(self, number: int, data: Bytes) -> None:
        """Takes a part; raises Refused unless it is missing and what was announced."""
        count = len(self._checksums)
        if number >= count:
            raise Refused(f"FactorPart.number is {number}; allowed: less than {count}", "shape")
        if number not in self.missing:
            raise Refused(f"FactorPart.number is {number}, which is there already", "duplicate")
        target = part(self._data, number, self._part_bytes)
        if len(data) != len(target):
            raise Refused(f"part {number} of a factor has {len(data)} bytes; allowed: {len(target)}", "size")
        target[:] = data
        if checksum(target) != self._checksums[number]:  # of the copy: memory that is shared may change meanwhile
            raise Refused(f"part {number} of a factor does not have the checksum that was announced for it", "checksum")
        self.missing.discard(number)
