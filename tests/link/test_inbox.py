# SPDX-License-Identifier: MIT
"""The order in which messages of workers are read."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from sim_server.network.inbox import Inbox


class Ring:
    """A ring of messages; `looked` is called before each read."""

    def __init__(self, *samples: str, looked: Callable[[], None] = lambda: None):
        self.samples, self.looked = list(samples), looked

    def try_recv(self) -> str | None:
        self.looked()
        return self.samples.pop(0) if self.samples else None


def inbox(**rings: Ring) -> Inbox:
    """An inbox with these rings instead of subscribers."""
    given = iter(rings.values())

    def declare(*_: Any, **__: Any) -> Ring:
        return next(given)

    session: Any = SimpleNamespace(
        declare_subscriber=declare, liveliness=lambda: SimpleNamespace(declare_subscriber=declare)
    )
    return Inbox(session, "sim")


def test_factors_are_taken_before_the_leaving_of_their_worker() -> None:
    found = list(inbox(worker=Ring("w"), pattern=Ring("p"), factor=Ring("f"), alive=Ring("gone")))
    assert found == [("worker", "w"), ("pattern", "p"), ("factor", "f"), ("alive_worker", "gone")]


def test_a_pattern_that_comes_while_factors_are_taken_is_not_late() -> None:
    """A worker sends the pattern and then the factor; both may come after patterns were looked at."""
    patterns = Ring()

    def arrive() -> None:
        if not patterns.samples and factors.samples == ["second"]:
            patterns.samples.append("of the second")

    factors = Ring("first", "second", looked=arrive)
    found = list(inbox(worker=Ring(), pattern=patterns, factor=factors, alive=Ring()))
    assert found == [("factor", "first"), ("pattern", "of the second"), ("factor", "second")]
