# SPDX-License-Identifier: MIT
"""A factor that came, until its inverse is posted."""

from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from protocol.factor import FactorPattern
from sim_server.arrays import Float64
from sim_server.backends.gpu.device_values import DeviceValues
from sim_server.backends.gpu.inverse.apply_inverse import Applied

Given = tuple[int, FactorPattern, NDArray[Any] | DeviceValues, int, int]
"""A body, and of its factor pattern, values, step, and the float16 numbers per entry that its inverse needs; 0: not
known yet."""


@dataclass(eq=False, slots=True)
class GivenFactor:
    """A factor that came. Its values do not change any more.

    step: of the matrix it was made from
    planes: float16 numbers per entry that its inverse needs; 0: not known yet
    wanted: it is to be used; False: once it is posted
    r: vector that its inverse is to be applied to. None: to none
    applied: P^-1 r on its way; None: nobody applies it
    source: its values where the inverse is built from, once its digits are chosen; None: as they came
    dropped: nobody wants it any more
    """

    pattern: FactorPattern
    values: NDArray[Any] | DeviceValues
    step: int
    planes: int = 0
    wanted: bool = True
    r: Float64 | None = None
    applied: "Future[Applied | None] | None" = None
    source: NDArray[Any] | DeviceValues | None = None
    dropped: bool = False

    def drop(self) -> None:
        """Gives it up."""
        self.dropped = True
        self.tell(None)

    def tell(self, applied: Applied | None) -> None:
        """Tells who waits for P^-1 r, if it is not told yet."""
        if self.applied is not None:
            with suppress(InvalidStateError):
                self.applied.set_result(applied)
