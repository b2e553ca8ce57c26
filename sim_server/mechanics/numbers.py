# SPDX-License-Identifier: MIT
"""Texts that name elements or faces by their numbers and ranges of them, as "3 7-9 12"."""

import re
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from sim_server.arrays import Int64

NUMBERS = re.compile(r"\s*(\d{1,9})(?:-(\d{1,9}))?(?:\s+|$)")


def ranges_of(text: str, what: str = "element") -> list[tuple[int, int]]:
    """Returns first and last number of each part of a text such as "3 7-9 12". Raises ValueError.

    what: is numbered, for messages
    """
    at, ranges = 0, []
    while at < len(text):
        found = NUMBERS.match(text, at)
        if found is None:
            raise ValueError(f'{text[at : at + 20]!r} is no list of {what} numbers and ranges such as "3 7-9 12"')
        first, last = int(found[1]), int(found[2] or found[1])
        if last < first:
            raise ValueError(f"{found[0].strip()!r} is no range of {what} numbers, from a lower to a higher one")
        ranges.append((first, last))
        at = found.end()
    return ranges


@lru_cache(maxsize=8)
def numbers_of(text: str, count: int) -> Int64:
    """Returns the numbers of such a text, ascending, once each, not to be changed. Raises ValueError.

    count: of the elements that there are, from 0
    """
    ranges, named = ranges_of(text), np.zeros(count, bool)
    if ranges and (last := max(last for _, last in ranges)) >= count:
        raise ValueError(f"there is no element {last}: numbers are from 0 to {count - 1}")
    for first, last in ranges:
        named[first : last + 1] = True
    return np.flatnonzero(named)


def text_of(numbers: Sequence[int] | Int64) -> str:
    """Returns numbers as a text of ranges, from which `numbers_of` reads them."""
    found = np.unique(np.asarray(numbers, np.int64))
    if not len(found):
        return ""
    first = np.flatnonzero(np.diff(found, prepend=found[0] - 2) > 1)
    last = np.append(first[1:], len(found)) - 1
    ends = zip(found[first].tolist(), found[last].tolist(), strict=True)
    return " ".join(str(a) if a == b else f"{a}-{b}" for a, b in ends)
