# SPDX-License-Identifier: MIT
"""Numbers that kernels of effects leave in each step and records come with: pressure of a cavity, tension of a cable.

They are those of the last evaluation of forces in the step.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sim_server.arrays import Float64, Int32


@dataclass(frozen=True)
class Measured:
    """One such number.

    body: index of the one that it belongs to
    of: what it tells of: the effect, cavity, or one of the tables of its list, cavity[1]
    quantity, unit: pressure, Pa
    array, index: it is array.ravel()[index], of a float64 array that kernels write
    """

    body: int
    of: str
    quantity: str
    unit: str
    array: Float64
    index: int


def first_of_bodies(measured: Sequence[Measured], bodies: int) -> Int32:
    """Returns the place of the first number of each body, (bodies + 1,). measured: in the order of bodies."""
    owners = np.array([each.body for each in measured], np.int64)
    return np.searchsorted(owners, np.arange(bodies + 1)).astype(np.int32)


def columns(
    array: Float64, owners: Sequence[int], effect: str, listed: Sequence[bool], quantities: Sequence[tuple[str, str]]
) -> list[Measured]:
    """Returns the numbers of an array that has a row for each cavity, cable, ... of the scene.

    owners: index of the body of each row, ascending. listed: by row, whether the object has a list of them
    quantities: name and unit of the first columns
    """
    width = array.shape[1]
    number = [owners[:row].count(owner) for row, owner in enumerate(owners)]
    return [
        Measured(owner, f"{effect}[{number[row]}]" if listed[row] else effect, name, unit, array, width * row + column)
        for row, owner in enumerate(owners)
        for column, (name, unit) in enumerate(quantities)
    ]
