# SPDX-License-Identifier: MIT
"""Who asked for which arrays: each belongs to the first that had it."""

from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

PLAIN = (str, bytes, int, float, bool, type(None), type, np.generic)


class Memory:
    """Arrays by who asked for them first. Views count as the array that they are of.

    closed: classes whose objects `take_all` does not look into
    """

    def __init__(self, *closed: type) -> None:
        self._closed = closed
        self._owner: dict[int, tuple[NDArray[Any], str]] = {}  # keeping an array keeps its id its own

    def take(self, array: NDArray[Any], owner: str) -> None:
        """Notes that `owner` has an array, unless another had it before."""
        while isinstance(array.base, np.ndarray):
            array = array.base
        if array.size:
            self._owner.setdefault(id(array), (array, owner))

    def take_all(self, thing: Any, owner: str) -> None:
        """Notes all arrays that can be reached from the attributes of an object of ours, however deep."""
        seen: dict[int, Any] = {}
        waiting = [thing]
        first = True
        while waiting:
            each = waiting.pop()
            if isinstance(each, np.ndarray):
                self.take(each, owner)
            elif not isinstance(each, PLAIN) and id(each) not in seen and (first or not isinstance(each, self._closed)):
                seen[id(each)] = each
                waiting += _parts(each)
            first = False

    def of(self, owner: str) -> list[NDArray[Any]]:
        """Returns the arrays of one."""
        return [array for array, name in self._owner.values() if name == owner]


def _parts(thing: Any) -> list[Any]:
    if isinstance(thing, dict):
        return list(thing.values())
    if isinstance(thing, list | tuple | set | frozenset):
        return list(thing)
    if callable(thing) or type(thing).__module__.split(".")[0] in ("ctypes", "builtins", "cupy", "threading"):
        return []
    slots = [getattr(thing, f.name) for f in fields(thing)] if is_dataclass(thing) else []
    return [*slots, *vars(thing).values()] if hasattr(thing, "__dict__") else slots
