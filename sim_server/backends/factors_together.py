# SPDX-License-Identifier: MIT
"""Factors of one pattern that came together, by columns."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar, overload

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor, FactorPattern

T = TypeVar("T")


@dataclass(eq=False, slots=True)
class FactorsTogether(Sequence[Factor]):
    """Factors of one pattern, by one method and worker, of different objects: a column for each attribute of Factor, in
    place of an object for each, which is made for who asks for it.

    values: (nonzeros,) of each
    reasons: why each is not to be used, empty if it is; None: they were not checked
    planes: float16 numbers an entry that the inverse of each needs (backends/gpu/inverse/digits.py); None: not known
    bodies: numbers of the objects; None: not told
    """

    pattern: FactorPattern
    worker: str
    method: str
    objects: list[str]
    epochs: list[int]
    steps: list[int]
    warps: list[bool]
    values: list[NDArray[Any]]
    seconds: list[float]
    remedies: list[str]
    reasons: list[str] | None = None
    planes: list[int] | None = None
    bodies: NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.objects)

    @overload
    def __getitem__(self, k: int) -> Factor: ...
    @overload
    def __getitem__(self, k: slice) -> "FactorsTogether": ...
    def __getitem__(self, k: int | slice) -> "Factor | FactorsTogether":
        if isinstance(k, slice):
            return self.of(range(*k.indices(len(self))))
        return Factor(
            self.objects[k], self.epochs[k], self.steps[k], self.warps[k], self.pattern, self.values[k], self.worker,
            self.seconds[k], self.remedies[k], method=self.method,
        )  # fmt: skip

    def __iter__(self) -> Iterator[Factor]:
        return (self[k] for k in range(len(self)))

    def of(self, rows: Sequence[int]) -> "FactorsTogether":
        """Returns some of them."""

        def chosen(column: list[T]) -> list[T]:
            return [column[k] for k in rows]

        return FactorsTogether(
            self.pattern, self.worker, self.method, chosen(self.objects), chosen(self.epochs), chosen(self.steps),
            chosen(self.warps), chosen(self.values), chosen(self.seconds), chosen(self.remedies),
            None if self.reasons is None else chosen(self.reasons),
            None if self.planes is None else chosen(self.planes),
            None if self.bodies is None else self.bodies[list(rows)],
        )  # fmt: skip
