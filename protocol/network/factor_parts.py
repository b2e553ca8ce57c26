# SPDX-License-Identifier: MIT
"""The values of a large factor as parts of equal size, the last one what is left."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.validate import checksum

Bytes = NDArray[np.uint8]


def bytes_of(values: NDArray[Any]) -> Bytes:
    """Returns the bytes of contiguous values (n,), in place."""
    return values.view(np.uint8)


def part_count(size: int, part_bytes: int) -> int:
    """Returns the number of parts of `size` bytes."""
    return -(-size // part_bytes)


def part(data: Bytes, number: int, part_bytes: int) -> Bytes:
    """Returns a part of the bytes, in place. number: from 0."""
    return data[number * part_bytes : (number + 1) * part_bytes]


def part_checksums(data: Bytes, part_bytes: int) -> list[int]:
    """Returns the checksum of each part."""
    return [checksum(part(data, k, part_bytes)) for k in range(part_count(len(data), part_bytes))]
