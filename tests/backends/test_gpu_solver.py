# SPDX-License-Identifier: MIT
"""What the solver of a GPU keeps of factors, which two threads ask it for."""

import threading
from types import SimpleNamespace
from typing import Any

import pytest

from tests.backends.pcg_on_threads import Solver
from tests.backends.test_gpu_correction import grabbed


class Address(int):
    """Of a plan. Whoever looks for it among others waits until another thread has done something, or for a while."""

    meanwhile: threading.Thread | None = None

    def __hash__(self) -> int:
        if self.meanwhile is not None and self.meanwhile.ident is None:
            self.meanwhile.start()
            self.meanwhile.join(0.3)
        return int(self)


def test_vectors_may_be_made_while_plans_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where some factors are built while others are posted."""
    solver, made = Solver(grabbed(), monkeypatch).solver, list[int]()

    def plan(address: int) -> Any:
        return SimpleNamespace(address=address, vectors=lambda: made.append(address) or {})

    first = Address(8)
    solver.reserve_vectors(0, plan(first))
    first.meanwhile = threading.Thread(target=solver.reserve_vectors, args=(0, plan(16)))
    solver.forget_plans(())
    first.meanwhile.join(30)
    for address in (first, 16):
        solver.reserve_vectors(0, plan(address))
    assert made == [8, 16], "each once"
