# SPDX-License-Identifier: MIT
"""Factors of several bodies are posted, prepared and dropped in any order, while steps go on and builds are slow."""

import random
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sim_server.backends.gpu import factor_upload as module
from sim_server.backends.gpu.factor_upload import FactorUpload
from sim_server.backends.gpu.upload import inverse_builds, inverse_posts
from tests.backends.fake_cuda import FakeScene
from tests.backends.test_factor_upload import Maker, NoMemory

BODIES, ROUNDS = 7, 120
PATTERNS = [SimpleNamespace(id=1), SimpleNamespace(id=2)]


class Uploads:
    """Does what a server does with factors, each of which has a number of its own.

    wanted: numbers of factors that were posted, by body. newest: the one posted last
    """

    def __init__(self, seed: int):
        self.random, self.scene = random.Random(seed), FakeScene(bodies=BODIES)
        self.maker = maker = Maker(self.scene)
        maker.bodies = np.zeros(BODIES, maker.bodies.dtype)
        maker.fine = {number for number in range(100_000) if number % 5 == 0}
        gpu: Any = SimpleNamespace(cp=SimpleNamespace(cuda=SimpleNamespace(get_current_stream=lambda: maker.stream)))
        maker.stream = SimpleNamespace(synchronize=maker.wait)
        names = [f"beam{k}" for k in range(BODIES)]
        self.upload = FactorUpload(gpu, maker, self.scene.loop, names, self.scene.loop.mailboxes_of_bodies(BODIES))
        build = maker.build_many

        def slow(*arguments: Any) -> Any:
            time.sleep(random.choice((0, 0, 0.002)))
            return build(*arguments)

        maker.build_many = slow
        self.number, self.finished = 0, 0
        self.wanted: list[set[int]] = [{0} for _ in range(BODIES)]
        self.newest = [0] * BODIES
        self.kept: dict[int, tuple[Any, np.ndarray]] = {}  # of each body, one that was prepared and not posted yet

    def made(self) -> tuple[Any, np.ndarray, int]:
        self.number += 1
        return self.random.choice(PATTERNS), np.array([self.number]), self.number

    def bodies(self) -> list[int]:
        return self.random.sample(range(BODIES), self.random.randint(1, BODIES))

    def posted(self, body: int, number: int) -> None:
        self.wanted[body].add(number)
        self.newest[body] = number
        self.kept.pop(body, None)

    def post(self) -> None:
        body, (pattern, values, number) = self.bodies()[0], self.made()
        self.posted(body, number)
        self.upload.post(body, pattern, values, number)

    def post_many(self) -> None:
        given = [(body, *self.made(), self.random.choice((0, 0, 1))) for body in self.bodies()]
        given = [(b, p, v, n, planes if n % 5 else 0) for b, p, v, n, planes in given]
        for body, *_, number, _ in given:
            self.posted(body, number)
        self.upload.post_many(given)

    def prepare_many(self) -> None:
        given = [(body, *self.made(), 0) for body in self.bodies()]
        self.upload.prepare_many(given)
        self.kept |= {body: (pattern, values) for body, pattern, values, *_ in given}

    def prepare(self) -> None:
        body, (pattern, values, number) = self.bodies()[0], self.made()
        if self.upload.may_prepare(body):
            self.upload.prepare(body, pattern, values, number, np.ones(3))
            self.kept[body] = pattern, values

    def post_prepared(self) -> None:
        given = [(body, p, v, int(v[0]), 0) for body, (p, v) in self.kept.items()]
        for body, *_, number, _ in given:
            self.posted(body, number)
        self.upload.post_many(given)

    def drop(self) -> None:
        for body, (_, values) in list(self.kept.items())[:3]:
            self.upload.drop(body, values)
            del self.kept[body]

    def events_come(self) -> None:
        """Inverses are complete in the order in which they were begun."""
        come = self.random.randint(self.finished, len(self.maker.events))
        for event in self.maker.events[self.finished : come]:
            event.synchronize()
        self.finished = come

    def step(self) -> None:
        self.upload.advance()
        self.scene.loop.run(1)
        self.look()

    def look(self) -> None:
        """What steps use was posted for that body, and is still in its storage."""
        there = {storage[0] for storage in self.maker.storages if storage}
        for body, number in enumerate(self.scene.factor.tolist()):
            assert number in self.wanted[body], "nobody posted it"
            assert number == 0 or number in there, "its storage was written to"

    def settle(self) -> None:
        self.upload.settle()
        self.scene.loop.run(1)
        self.look()
        assert self.scene.factor.tolist() == self.newest
        assert [self.upload.step(body) for body in range(BODIES)] == [number or -1 for number in self.newest]


@pytest.mark.parametrize("seed", range(6))
def test_only_what_was_posted_is_used_and_the_newest_in_the_end(seed, monkeypatch):
    for each in (inverse_builds, inverse_posts):
        monkeypatch.setattr(each, "no_memory_left", lambda error: isinstance(error, NoMemory))
    monkeypatch.setattr(module, "TOGETHER", 3)
    monkeypatch.setattr(module, "SMALL", 4 if seed % 3 == 2 else 1 << 20)  # large ones are built one by one
    uploads = Uploads(seed)
    acts = [uploads.post, uploads.post_many, uploads.prepare_many, uploads.prepare, uploads.post_prepared, uploads.drop]
    for _ in range(ROUNDS):
        uploads.random.choice(acts)()
        for _ in range(uploads.random.randint(0, 2)):
            uploads.random.choice((uploads.events_come, uploads.step))()
        if uploads.random.random() < 0.05:
            uploads.settle()
    uploads.settle()
