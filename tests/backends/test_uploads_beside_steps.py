# SPDX-License-Identifier: MIT
"""Factors are prepared by one thread, posted by another and built by a third, while steps go on in a fourth."""

import queue
import sys
import threading
from itertools import count
from typing import Any

import numpy as np
import pytest

from sim_server.backends.gpu import factor_upload as module
from sim_server.backends.gpu.upload import inverse_builds, inverse_posts
from tests.backends.test_factor_upload import NoMemory
from tests.backends.test_uploads_at_random import BODIES, PATTERNS, Uploads

ROUNDS = 250


class Beside(Uploads):
    """As Uploads, with a thread for each of what a server has threads for.

    used: numbers of the factors that steps had, one after another, by body. wrong: those whose storage had been written
    to when a step began
    """

    def __init__(self, seed: int):
        super().__init__(seed)
        self.numbers, self.prepared = count(1), queue.SimpleQueue[list[Any]]()
        self.used: list[list[int]] = [[0] for _ in range(BODIES)]
        self.wrong: list[int] = []
        self.failed: list[BaseException] = []
        self.ended = threading.Event()
        storages, build, step = dict[int, list[int]](), self.maker.build_many, self.scene.make_step

        def noted(values: list[np.ndarray], own: list[list[int]], limit: int | None) -> Any:
            event = build(values, own, limit)
            storages.update((int(each[0]), storage) for each, storage in zip(values, own, strict=True))
            return event

        def looked_at() -> None:
            for body, number in enumerate(self.scene.factor.tolist()):
                if number and storages.get(number, [0])[0] != number:
                    self.wrong.append(number)
                if number != self.used[body][-1]:
                    self.used[body].append(number)
            step()

        self.maker.build_many, self.scene.make_step = noted, looked_at
        self.scene.loop.run(1)  # what it takes is compiled
        self.scene.device.set("event_query", self.looked)
        loop = self.scene.loop.loop
        loop.exchange_seconds = loop.batch_seconds = 1e-12  # one step in a batch, of which there are two under way

    def given(self) -> list[Any]:
        each = [(body, self.random.choice(PATTERNS), np.array([next(self.numbers)])) for body in self.bodies()]
        return [(body, pattern, values, int(values[0]), 0) for body, pattern, values in each]

    def looked(self, event: int) -> int:
        """Steps are under way for a while: mostly nothing is done when somebody looks."""
        self.scene.device.pieces = int(self.random.random() < 0.1)
        return self.scene.device.event_query(event)

    def steps(self) -> None:
        self.scene.loop.run(8)

    def prepare(self) -> None:
        given = self.given()
        self.upload.prepare_many(given)
        self.prepared.put(given)
        self.ended.wait(1e-3)

    def thread(self, act: Any) -> threading.Thread:
        def run() -> None:
            try:
                while not self.ended.is_set():
                    act()
            except BaseException as error:
                self.failed.append(error)

        made = threading.Thread(target=run)
        made.start()
        return made

    def post_some(self) -> None:
        """Posts factors that were prepared, or others, and drops some."""
        given = self.given() if self.prepared.empty() or self.random.random() < 0.3 else self.prepared.get()
        for body, _, values, *_ in given[3:5]:
            self.upload.drop(body, values)
        chosen = [each for k, each in enumerate(given) if k not in (3, 4) and each[3] > self.newest[each[0]]]
        for body, *_, number, _ in chosen:
            self.posted(body, number)
        self.upload.post_many(chosen)

    def go_on(self) -> None:
        """What the thread that serves the loop does besides."""
        self.upload.advance()
        self.scene.loop.records()
        self.events_come()


@pytest.mark.parametrize("seed", range(2))
def test_no_step_has_what_nobody_posted_or_what_is_written_to(seed, monkeypatch):
    for each in (inverse_builds, inverse_posts):
        monkeypatch.setattr(each, "no_memory_left", lambda error: isinstance(error, NoMemory))
    monkeypatch.setattr(module, "TOGETHER", 3)
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-5)
    uploads = Beside(seed)
    threads = [uploads.thread(act) for act in (uploads.steps, uploads.prepare)]
    try:
        for _ in range(ROUNDS):
            uploads.post_some()
            uploads.go_on()
            uploads.ended.wait(1e-3)
    finally:
        uploads.ended.set()
        while any(thread.is_alive() for thread in threads):
            uploads.scene.loop.records()  # it may wait for room
            threads[0].join(0.01), threads[1].join(0.01)
        sys.setswitchinterval(interval)
    uploads.settle()
    uploads.scene.loop.run(1)
    assert not uploads.failed and not uploads.wrong
    for body, used in enumerate(uploads.used):
        assert used == sorted(used) and set(used) <= uploads.wanted[body] and used[-1] == uploads.newest[body]
        assert len(used) > 1
