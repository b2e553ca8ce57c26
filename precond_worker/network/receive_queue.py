# SPDX-License-Identifier: MIT
"""A bounded queue of received items; network threads only append to it."""

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class ReceiveQueue(Generic[T]):
    """Drops the oldest item when it is full, so that a sender never blocks.

    wake: set by each item, for a reader of several queues.
    """

    def __init__(self, capacity: int, wake: threading.Event | None = None):
        self._wake = wake
        self._items: deque[T] = deque(maxlen=capacity)
        self._in_hand = False  # items were taken and are not done yet
        self._arrived = threading.Condition()
        self.dropped = 0

    def put(self, item: T) -> None:
        """Appends an item; never waits for the reader."""
        with self._arrived:
            self.dropped += len(self._items) == self._items.maxlen
            self._items.append(item)
            self._arrived.notify()
        if self._wake is not None:
            self._wake.set()

    def take(self, timeout: float) -> list[T]:
        """Takes all items, oldest first; waits up to `timeout` seconds for the first."""
        with self._arrived:
            if not self._items:
                self._arrived.wait(timeout)
            items = list(self._items)
            self._items.clear()
            self._in_hand = self._in_hand or bool(items)
            return items

    def done(self) -> None:
        """Marks all items taken so far as done."""
        self._in_hand = False

    @property
    def idle(self) -> bool:
        """True if the queue is empty and all items taken are done. From any thread."""
        with self._arrived:
            return not self._items and not self._in_hand
