# SPDX-License-Identifier: MIT
"""A worker that answers at once: precond-worker itself, but for a memory of the factors of matrices that it had before.

It shows what a server can take in, as a GPU that factorizes many matrices in one launch would send it.
"""

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from precond_worker import cli
from precond_worker.factorization import registry
from precond_worker.factorization.modified_cholesky import ModifiedCholesky
from precond_worker.many import Begun, Made, Matrices
from protocol.channels import MOST_JOBS
from protocol.factor import FactorPattern
from protocol.method import Method
from protocol.validate import checksum


class Remembering:
    """Complete factors; each matrix is factorized once."""

    most = together = MOST_JOBS

    def __init__(self, row_start: Any, columns: Any, method: Method | None = None, library: str = "auto"):
        self._made = ModifiedCholesky(row_start, columns, library)
        self._known: dict[tuple[int, str], NDArray[Any]] = {}
        self.remedy = ""

    @property
    def pattern(self) -> FactorPattern:
        """Of L."""
        return self._made.pattern

    @property
    def library(self) -> str:
        """What computes, for people."""
        return self._made.library

    def factorize(self, values: Any, dtype: Any) -> NDArray[Any]:
        """Returns L of a matrix, from memory if it is known."""
        key = checksum(np.ascontiguousarray(values)), np.dtype(dtype).name
        if key not in self._known:
            self._known[key] = np.ascontiguousarray(self._made.factorize(values, dtype)).copy()
        return self._known[key]

    def begin_many(self, matrices: Matrices, dtype: Any) -> Begun:
        """As a GPU does with matrices of one pattern."""
        given = np.empty((len(matrices), 9 * matrices.blocks))
        matrices.copy_to(given)
        made = np.stack([self.factorize(each.reshape(-1, 3, 3), dtype) for each in given])
        return Begun(lambda: Made(made, np.ones(len(made), np.bool_)), beside=True)


if __name__ == "__main__":
    registry.make_factorization = Remembering
    sys.exit(cli.main())
