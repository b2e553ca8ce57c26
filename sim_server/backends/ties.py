# SPDX-License-Identifier: MIT
"""Attachments and springs as input of an engine (forces: kernels/ties.cuh)."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sim_server.arrays import Float64, Int32


@dataclass(frozen=True)
class Ties:
    """Rows that bind a point to another one, in the order of the bodies of their first corners.

    corner, weight: (n, 4) as of contact (backends/contact.py): the first corner has weight 1, the others below 0
    body: (n, 2) of the first corner and of the others; -1: there are none
    obstacle: (n,) -1: none; point: (n, 3) in its frame [m]
    table: (n,) number of the attachment or spring that it is of; tables: how many there are
    kappa: (n,) of attachments, 0: a spring. rest: (n,) length of springs [m]. breaking: (n,) force [N]
    stiffness: (n,) [N/m]; 0: set in the first step
    force: (n, 3) on the first corner in the last step [N]
    broken: (n,) steps completed when it broke; 0: it has not
    reaction: (bodies, columns, 6), force and torque by each body; those of tables begin at `column`
    """

    corner: Int32
    weight: Float64
    body: Int32
    obstacle: Int32
    point: Float64
    table: Int32
    tables: int
    kappa: Float64
    rest: Float64
    breaking: Float64
    stiffness: Float64
    force: Float64
    broken: Int32
    reaction: Float64
    column: int

    def rows(self, body: int) -> Any:
        """Returns the rows that bind a body to something."""
        return np.flatnonzero((self.body == body).any(axis=1))
