# SPDX-License-Identifier: MIT
"""Factorizations by method (protocol.method)."""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

from numpy.typing import ArrayLike, NDArray

from protocol.factor import FactorPattern
from protocol.method import Method

__all__ = ["DeviceFactorization", "Factorization", "make_factorization"]


@runtime_checkable
class DeviceFactorization(Protocol):
    """A factorization that may leave matrix and factor on a device: ModifiedCholesky."""

    remedy: str

    def factorize_on_device(self, matrix: int, dtype: Any) -> Callable[[int], None] | None: ...


class Factorization(Protocol):
    """Makes factors of matrices of one block pattern.

    pattern, remedy: of the last factor; remedy says what was done to a matrix that was not positive definite, empty if
    it was. library: what computes, for people.
    """

    remedy: str

    @property
    def pattern(self) -> FactorPattern: ...

    @property
    def library(self) -> str: ...

    def factorize(self, values: Any, dtype: Any) -> NDArray[Any]: ...


def make_factorization(
    row_start: ArrayLike, columns: ArrayLike, method: Method | None = None, library: str = "auto"
) -> Factorization:
    """Returns the factorization of `method` for a block pattern; complete Cholesky by default.

    row_start, columns, library: as of factorize.Analysis, which makes complete factors. Incomplete ones are made by
    native code on the CPU. Raises what Analysis raises.
    """
    chosen = (method or Method()).check()
    if chosen.name == "cholesky":
        from precond_worker.factorization.modified_cholesky import ModifiedCholesky

        return ModifiedCholesky(row_start, columns, library)
    from precond_worker.factorization.incomplete import IncompleteCholesky, Ssor

    return (Ssor if chosen.name == "ssor" else IncompleteCholesky)(row_start, columns, chosen)
