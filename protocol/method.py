# SPDX-License-Identifier: MIT
"""Methods of factorization: which factor a worker makes of a matrix."""

import math
from dataclasses import dataclass

from protocol.refused import Refused

__all__ = ["COMPLETE", "METHODS", "Method"]

COMPLETE = "cholesky"  # the method whose factors have a pattern that the matrix alone decides
METHODS = (COMPLETE, "incomplete_cholesky", "ssor")


@dataclass(frozen=True)
class Method:
    """A factor L whose L L^T approximates the matrix; an exact one by default.

    incomplete_cholesky: blocks of L smaller than drop_tolerance times the norm of their row are left out, and of a
        column the smallest if there are more than `fill` times as many as a column of the matrix has (0: no bound).
    ssor: the symmetric successive over-relaxation of the matrix with relaxation omega.
    """

    name: str = COMPLETE
    drop_tolerance: float = 0.0
    fill: float = 0.0
    omega: float = 1.0

    def check(self) -> "Method":
        """Returns the method itself; raises Refused if a number is out of the range of the method."""
        if self.name not in METHODS:
            raise Refused(f"Matrix.method is {self.name!r}; allowed: {', '.join(METHODS)}", "malformed")
        if self.name == "incomplete_cholesky":
            if not 0 <= self.drop_tolerance < 1:
                raise Refused(
                    f"Matrix.drop_tolerance is {self.drop_tolerance}; allowed: at least 0, below 1", "malformed"
                )
            if not (math.isfinite(self.fill) and self.fill >= 0):
                raise Refused(f"Matrix.fill is {self.fill}; allowed: 0 or more", "malformed")
        if self.name == "ssor" and not 0 < self.omega < 2:
            raise Refused(f"Matrix.omega is {self.omega}; allowed: above 0, below 2", "malformed")
        return self
