# SPDX-License-Identifier: MIT
"""Sending without waiting: a thread of its own with a bounded queue."""

import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable

import zenoh

log = logging.getLogger(__name__)

Send = Callable[[], None]


class SendQueue:
    """Runs posted sends one after another. What is posted under a name replaces what still waits under it."""

    def __init__(self, name: str, capacity: int):
        self._capacity = capacity
        self._waiting: OrderedDict[Hashable, Send] = OrderedDict()
        self._changed = threading.Condition()
        self._open = True
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def post(self, send: Send, name: Hashable = None) -> bool:
        """Queue a send; False if the queue is full or an older send of the same name was dropped for it."""
        with self._changed:
            if not self._open:
                return False
            replaced = name is not None and self._waiting.pop(name, None) is not None
            if len(self._waiting) >= self._capacity:
                return False
            self._waiting[object() if name is None else name] = send
            self._changed.notify()
            return not replaced

    def _run(self) -> None:
        while True:
            with self._changed:
                while self._open and not self._waiting:
                    self._changed.wait()
                if not self._waiting:
                    return
                _, send = self._waiting.popitem(last=False)
            try:
                send()
            except zenoh.ZError as error:
                log.warning("a message was not sent: %s", error)
            except Exception:
                log.exception("a message was not sent")
            del send  # it may hold a slot

    def close(self, timeout: float = 1.0, finish: bool = False) -> None:
        """End the thread; what waits is dropped, or sent first (finish). A send may outlive the timeout."""
        with self._changed:
            self._open = False
            if not finish:
                self._waiting.clear()
            self._changed.notify()
        self._thread.join(timeout)
