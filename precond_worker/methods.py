# SPDX-License-Identifier: MIT
"""A method made ready for matrices of one block pattern."""

from typing import Any, Protocol

from numpy.typing import ArrayLike, NDArray

from protocol import FactorPattern
from protocol.method import Method

__all__ = ["Factorization", "prepared"]


class Factorization(Protocol):
    """What makes factors. pattern, remedy: of the factor made last (remedy: what was done to a matrix that was not
    positive definite, empty if it was); library: what computes."""

    remedy: str

    @property
    def pattern(self) -> FactorPattern: ...

    @property
    def library(self) -> str: ...

    def factorize(self, values: Any, dtype: Any) -> NDArray[Any]: ...


def prepared(
    row_start: ArrayLike, columns: ArrayLike, method: Method | None = None, library: str = "auto"
) -> Factorization:
    """row_start, columns, library: as of factorize.Analysis, which makes complete factors; incomplete ones are always
    made by our own code on the CPU. Raises what Analysis raises."""
    chosen = (method or Method()).check()
    if chosen.name == "cholesky":
        from precond_worker.remedies import Cholesky

        return Cholesky(row_start, columns, library)
    from precond_worker.incomplete import IncompleteCholesky, Ssor

    return (Ssor if chosen.name == "ssor" else IncompleteCholesky)(row_start, columns, chosen)
