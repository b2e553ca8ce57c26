# SPDX-License-Identifier: MIT
"""Arrays that one step leaves to the next: what a reset puts back and a checkpoint holds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class StateArray:
    """One array, wherever it is.

    name: unique in a simulation, the same whenever its scene is built
    read: returns a copy; write: sets it. Both while the loop stands still
    rows: returns which of its rows belong to a body (an index of NumPy); None: none belongs to one alone
    resets: a reset puts it back; False: it is only known to the solver (corrections of factors, costs), or is reset
        in another way
    added: of the versions with it; checkpoints of earlier ones lack it, and go on with what the start has
    """

    name: str
    read: Callable[[], NDArray[Any]]
    write: Callable[[NDArray[Any]], None]
    rows: Callable[[int], Any] | None = None
    resets: bool = True
    added: bool = False


def host_array(
    name: str, array: NDArray[Any], rows: Callable[[int], Any] | None = None, resets: bool = True
) -> StateArray:
    """Returns an array in memory of the host."""

    def write(values: NDArray[Any]) -> None:
        array[...] = values

    return StateArray(name, array.copy, write, rows, resets)


def numbers_array(name: str, struct: Any) -> StateArray:
    """Returns the numbers of a ctypes structure, without its pointers, as one packed row; no reset takes them back."""
    numbers = numbers_of(struct)
    packed = np.dtype([(n, numbers.dtype[n]) for n in numbers.dtype.names or ()])

    def write(values: NDArray[Any]) -> None:
        for member in packed.names or ():
            numbers[member] = values[member]

    def read() -> NDArray[Any]:
        found = np.zeros(len(numbers), packed)
        for member in packed.names or ():
            found[member] = numbers[member]
        return found

    return StateArray(name, read, write, resets=False)


def memory_of(structs: Any, count: int) -> NDArray[np.uint8]:
    """Returns an array of ctypes structures, none of which holds a pointer, as bytes (count, size)."""
    return np.frombuffer(structs, np.uint8).reshape(count, -1)


def numbers_of(struct: Any) -> NDArray[Any]:
    """Returns the members of a ctypes structure that are numbers, no pointers, as one row of a structured array."""
    import ctypes as c

    numbers = [(n, kind) for n, kind, *_ in struct._fields_ if issubclass(kind, c._SimpleCData) and kind != c.c_void_p]
    dtype = np.dtype({
        "names": [n for n, _ in numbers], "formats": [np.dtype(kind) for _, kind in numbers],
        "offsets": [getattr(type(struct), n).offset for n, _ in numbers], "itemsize": c.sizeof(struct),
    })  # fmt: skip
    return np.frombuffer(struct, dtype)


def same_body(body: int) -> slice:
    """Rows of arrays with one row for each body."""
    return slice(body, body + 1)


def rows_in(bodies: NDArray[Any]) -> Callable[[int], Any]:
    """Returns the rows of a body. bodies: (rows,) of each row."""
    return lambda body: np.flatnonzero(bodies == body)
