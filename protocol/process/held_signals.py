# SPDX-License-Identifier: MIT
"""Signals whose exceptions wait: raised at whatever line is under way, one would leave half done what that does."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class HeldSignal:
    """The first signal that came. came: whether there is one"""

    def __init__(self) -> None:
        self._act: Callable[[], object] | None = None

    @property
    def came(self) -> bool:
        """True once one waits."""
        return self._act is not None

    def hold(self, act: Callable[[], object]) -> bool:
        """Keeps what a signal does. False: one waits already, and who sends another one does not want to wait."""
        first = self._act is None
        if first:
            self._act = act
        return first

    def act(self) -> None:
        """Does what it has kept."""
        if self._act is not None:
            self._act()


_holding: list[HeldSignal] = []  # the innermost last


@contextmanager
def held_signals() -> Iterator[HeldSignal]:
    """Within it, in the main thread, the first signal that command_line.handle knows waits until the end, unless that
    is an exception. Who uses it looks at `came`. A second one acts at once."""
    held = HeldSignal()
    if threading.current_thread() is not threading.main_thread():  # which has no part in signals
        yield held
        return
    _holding.append(held)
    try:
        yield held
    finally:
        _holding.remove(held)
    held.act()


def hold(act: Callable[[], object]) -> bool:
    """Has a signal wait, where one may. Returns whether it does."""
    return bool(_holding) and _holding[-1].hold(act)
