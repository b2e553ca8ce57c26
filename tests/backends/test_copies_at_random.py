# SPDX-License-Identifier: MIT
"""Matrices and positions of several bodies are asked for in any order while steps go on: each comes to who asked."""

import random

import numpy as np
import pytest

from sim_server.backends.gpu import loop as loop_module
from tests.backends.fake_cuda import FakeScene

BODIES, ROUNDS = 7, 120


class Asked:
    """Asks for what each body has of its own: A = 100 k + body in step k (from 0), x = 100 (k + 1) + body + 50.

    asked: of each body, memory for what was asked for, and whether it is a matrix
    last: in memory of the loop, what came last of each, which the next copy leaves alone
    """

    def __init__(self, seed: int, real: str):
        self.random, self.scene = random.Random(seed), FakeScene(bodies=BODIES, real=real)
        self.scene.device.pieces = self.random.choice((1, 3, 10))  # of work between two looks
        loop, step = self.scene.loop, self.scene.make_step
        loop.loop.exchange_seconds, loop.loop.batch_seconds = self.random.choice(((1e-12, 1e-12), (5e-4, 2e-3)))
        self.loop, own = loop, np.repeat(np.arange(BODIES), 2)

        def told() -> None:
            step()
            self.scene.values[:] = 100 * (self.scene.done - 1) + own[:, None, None]
            self.scene.x[:] = 100 * self.scene.done + own[:, None] + 50

        self.scene.make_step = told  # type: ignore[method-assign]
        self.asked: dict[int, tuple[np.ndarray, bool]] = {}
        self.last: dict[int, tuple[np.ndarray, int]] = {}
        self.came = 0

    def free(self) -> list[int]:
        return self.random.sample(free := sorted(set(range(BODIES)) - self.asked.keys()), len(free))

    def matrices(self) -> None:
        bodies = self.free()[: self.random.randint(1, BODIES)]
        found = self.loop.request_matrices(np.array(bodies, np.int64))
        if found is None:
            for body in bodies:
                self.asked[body] = np.zeros((2, 3, 3)), True
                self.loop.request_matrix(body, self.asked[body][0])
            return
        assert [memory.ctypes.data for memory in found[0]] == found[1].tolist()
        self.asked |= {body: (memory, True) for body, memory in zip(bodies, found[0], strict=True)}

    def one(self) -> None:
        for body in self.free()[:1]:
            if self.random.random() < 0.5:
                self.asked[body] = np.zeros((2, 3)), False
                self.loop.request_positions(body, self.asked[body][0])
            else:
                own = self.loop.copy_memory(body)
                self.asked[body] = np.zeros((2, 3, 3)) if own is None else own, True
                self.loop.request_matrix(body, self.asked[body][0])

    def mail(self) -> None:
        self.loop.mailboxes[self.random.randrange(BODIES)].post(np.int64(self.came).tobytes())

    def run(self) -> None:
        self.loop.run(self.random.randint(1, 5))
        self.loop.records()

    def look(self) -> None:
        steps = self.loop.matrix_steps(np.arange(BODIES)).tolist()
        for body in [body for body in self.asked if steps[body] >= 0]:
            memory, matrix = self.asked.pop(body)
            value = 100 * steps[body] + body + (0 if matrix else 150)
            assert (memory == value).all(), (body, steps[body])
            self.last.pop(body, None)
            if memory.base is not None:
                self.last[body] = memory, value
            self.came += 1
        for memory, value in self.last.values():
            assert (memory == value).all(), "who has it may still read it"


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("memory", ["of the loop", "of another type", "for one copy"])
def test_each_body_has_its_own_whole_and_in_time(seed, memory, monkeypatch):
    if memory == "for one copy":
        monkeypatch.setattr(loop_module, "DOUBLED", 100)
    asked = Asked(seed, "f4" if memory == "of another type" else "f8")
    acts = [asked.matrices, asked.one, asked.mail, asked.run, asked.run, asked.run]
    for _ in range(ROUNDS):
        asked.random.choice(acts)()
        asked.look()
    assert asked.came > BODIES and bool(asked.last) == (memory == "of the loop")
