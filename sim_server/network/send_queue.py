# SPDX-License-Identifier: MIT
"""Sends messages from a thread of its own with a bounded queue, so that no caller waits for the network."""

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable

import zenoh

log = logging.getLogger(__name__)

Send = Callable[[], None]


class SendQueue:
    """Runs posted functions one after another. One posted under a name replaces the one that waits under that name."""

    def __init__(self, name: str, capacity: int):
        self._capacity = capacity
        self._queue: OrderedDict[Hashable, Send] = OrderedDict()
        self._changed = threading.Condition()
        self._open = True
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def post(self, send: Send, name: Hashable = None) -> bool:
        """Queues a function; False if the queue is full or an older function of that name was dropped for it."""
        with self._changed:
            if not self._open:
                return False
            replaced = name is not None and self._queue.pop(name, None) is not None
            if len(self._queue) >= self._capacity:
                return False
            self._queue[object() if name is None else name] = send
            self._changed.notify()
            return not replaced

    def _run(self) -> None:
        while True:
            with self._changed:
                while self._open and not self._queue:
                    self._changed.wait()
                if not self._queue:
                    return
                _, send = self._queue.popitem(last=False)
            try:
                send()
            except zenoh.ZError as error:
                log.warning("a message was not sent: %s", error)
            except Exception:
                log.exception("a message was not sent")
            del send  # it may hold a slot

    def close(self, timeout: float = 1.0, finish: bool = False) -> None:
        """Ends the thread. The function that is running may outlive the timeout [s].

        finish: run what is queued first instead of dropping it
        """
        with self._changed:
            self._open = False
            if not finish:
                self._queue.clear()
            self._changed.notify()
        self._thread.join(timeout)
