# SPDX-License-Identifier: MIT
"""What arrived and was not looked at yet: a bounded queue that network threads only append to."""

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Mailbox(Generic[T]):
    """The oldest item goes when it is full, so that it never blocks a sender.

    bell: set by each item, for a reader of several mailboxes.
    """

    def __init__(self, capacity: int, bell: threading.Event | None = None):
        self._bell = bell
        self._items: deque[T] = deque(maxlen=capacity)
        self._in_hand = False  # what was taken is not dealt with yet
        self._arrived = threading.Condition()
        self.dropped = 0

    def put(self, item: T) -> None:
        """Append an item; never waits for the reader."""
        with self._arrived:
            self.dropped += len(self._items) == self._items.maxlen
            self._items.append(item)
            self._arrived.notify()
        if self._bell is not None:
            self._bell.set()

    def take(self, timeout: float) -> list[T]:
        """All items, oldest first; waits up to timeout seconds for the first."""
        with self._arrived:
            if not self._items:
                self._arrived.wait(timeout)
            items = list(self._items)
            self._items.clear()
            self._in_hand = self._in_hand or bool(items)
            return items

    def done(self) -> None:
        """All that was taken so far is dealt with."""
        self._in_hand = False

    @property
    def idle(self) -> bool:
        """Nothing is here, and all that was taken is dealt with. From any thread."""
        with self._arrived:
            return not self._items and not self._in_hand
