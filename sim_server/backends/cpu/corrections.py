# SPDX-License-Identifier: MIT
"""What the loop of a CPU knows of changes of A since the matrix of a factor, and room to correct the factor for it."""

import ctypes as c
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64
from sim_server.backends.base import CutInput
from sim_server.backends.cpu import structs
from sim_server.backends.state import StateArray, host_array, numbers_array

HISTORY = 1024  # changes of the diagonal that are remembered, of each body
KNOWN_CONTACTS = 32, 16384  # blocks of contacts that are remembered: of each surface node of a body, and of all at most
KNOWN_DIAGONALS = 8  # copies of a body that are remembered: more than are under way at a time
LARGEST_CUT = 4_000_000  # entries of the envelope
WIDEST_CUT = 30 * 9  # as ENOUGH_FOR_CUTS of native/cut_nodes.h, in numbers of A a block


class NativeCorrection:
    """What has come onto the diagonal of a body since the matrix of its factor, or has left it (native/woodbury.h).

    nodes: that are corrected at most. diagonal, block: as in base.Engine. double: also factors in float64.
    surface: nodes of its surface; None: nothing touches
    """

    def __init__(
        self, body: structs.Body, nodes: int, diagonal: Float64, double: bool, block: Float64 | None,
        surface: int | None,
    ):  # fmt: skip
        assert 1 <= nodes <= structs.MAX_CORRECTED
        self._body, self._resumed = body, False
        count, width = body.last - body.first, -(-3 * nodes // 8) * 8
        room: dict[str, NDArray[Any]] = {
            "last": np.full(count, 0.0), "then": np.full(count, 0.0),
            "change": np.zeros(HISTORY, structs.CHANGE),
            "node": np.full(nodes, 0, np.int32), "supernode": np.full(3 * count, 0, np.int32),
            "marked": np.full(3 * count, 0, np.uint8), "delta": np.full((3 * nodes, 3 * nodes), 0.0),
            "small": np.full(4 * width**2 + 2 * width, 0.0),
            "columns": np.zeros((3 * count, width), np.float64 if double else np.float32),  # touched by the first grab
        }  # fmt: skip
        correction = body.correction
        correction.capacity, correction.history, correction.nodes, correction.forgotten = nodes, HISTORY, count, -1
        if surface is not None:
            each, most = KNOWN_CONTACTS
            touches = min(each * surface, most)
            correction.touches, correction.touch_lost = touches, -1
            room |= {
                "touch": np.zeros(touches, structs.KNOWN_CONTACT), "touch_now": np.zeros((count, 9)),
                "touch_then": np.zeros((count, 9)), "link_now": np.zeros(touches, structs.KNOWN_CONTACT),
                "link_then": np.zeros(touches, structs.KNOWN_CONTACT),
            }  # fmt: skip
        self._room = room
        self._assembled = {"diagonal": diagonal[body.first : body.last]}
        if block is not None:
            self._assembled["block"] = block[body.first : body.last]
        for name, array in (room | self._assembled).items():
            setattr(correction, name, array.ctypes.data)

    def state(self, name: str) -> list[StateArray]:
        """Returns what is known of the changes since the matrix of the factor in use. No reset takes it back."""
        body = self._body

        def is_of_factor() -> NDArray[Any]:
            return np.array([bool(body.factor) and not body.mail and body.correction.factor == body.factor])

        def set_of_factor(value: NDArray[Any]) -> None:
            self._resumed = bool(value[0])

        found = [numbers_array(f"{name}.numbers", body.correction)]
        found.append(StateArray(f"{name}.is_of_factor", is_of_factor, set_of_factor, resets=False))
        return found + [host_array(f"{name}.{k}", a, resets=False) for k, a in self._room.items()]

    def resume(self, factor: int) -> None:
        """Takes the factor at an address for the one in use, if the state that was read was of that."""
        if self._resumed:
            self._body.correction.factor = factor


class NativeRefresh:
    """What A of a body had on its diagonal when copies were taken, and room to solve directly where it changed most."""

    def __init__(self, body: Any, blocks: int):
        n = body.last - body.first
        capacity = min(WIDEST_CUT * blocks, LARGEST_CUT)
        self.carried: dict[str, NDArray[Any]] = {
            "step": np.full(KNOWN_DIAGONALS, -1, np.int64), "block": np.zeros((KNOWN_DIAGONALS, n, 6), np.float32)
        }  # fmt: skip
        self._room: dict[str, NDArray[Any]] = {
            "at_rest": np.zeros(n), "changed_at": np.zeros(n), "free": np.ones(n), "node": np.zeros(n, np.int32),
            "place": np.zeros(n, np.int32), "first": np.zeros(3 * n, np.int32), "row": np.zeros(3 * n, np.int64),
            "envelope": np.zeros(capacity), "t": np.zeros(3 * n), "room": np.zeros(3 * n),
        }  # fmt: skip
        self._score = np.zeros(n)
        self._nodes = structs.CutNodes(nodes=n, capacity=capacity)
        for name, array in self._room.items():
            setattr(self._nodes, name, array.ctypes.data)
        self.native = structs.KnownDiagonals(
            kept=KNOWN_DIAGONALS, slow=-1, score=self._score.ctypes.data, room=c.addressof(self._nodes),
            **{name: array.ctypes.data for name, array in self.carried.items()},
        )  # fmt: skip
        body.correction.known = c.addressof(self.native)

    def state(self, name: str) -> list[StateArray]:
        """Returns what steps carry on; no reset takes it back."""
        arrays = [host_array(f"{name}.{k}", a, resets=False) for k, a in self.carried.items()]
        return [replace(a, added=True) for a in (numbers_array(f"{name}.numbers", self.native), *arrays)]


class NativeCut:
    """Nodes of a body that may lose elements, and room for a direct solve on those that did."""

    def __init__(self, given: CutInput, body: Any, dt: float, arrays: Mapping[str, NDArray[Any]]):
        n = body.last - body.first
        blocks = int(arrays["row_start"][body.last] - arrays["row_start"][body.first])
        capacity = min(int((WIDEST_CUT * blocks * 3 * n) ** 0.5), LARGEST_CUT)  # rows of these widths have no more
        room: dict[str, NDArray[Any]] = {
            "node": np.zeros(n, np.int32), "place": np.zeros(n, np.int32), "first": np.zeros(3 * n, np.int32),
            "row": np.zeros(3 * n, np.int64), "envelope": np.zeros(capacity), "t": np.zeros(3 * n),
            "room": np.zeros(3 * n),
        }  # fmt: skip
        room |= {name: getattr(given, name)[body.first : body.last] for name in ("at_rest", "changed_at", "free")}
        if given.origin is not None and given.copied_at is not None:
            room |= {"origin": given.origin[body.first : body.last], "root": np.zeros(n, np.int32)}
            room["copied_at"] = given.copied_at[body.first : body.last]
        self._room = room
        self.native = structs.CutNodes(nodes=n, capacity=capacity, dt=dt)
        for name, array in room.items():
            setattr(self.native, name, array.ctypes.data)
        body.correction.cut = c.addressof(self.native)
