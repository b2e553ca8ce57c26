# SPDX-License-Identifier: MIT
"""What wakes the thread that serves the loop."""

import os
import select
import threading
from pathlib import Path

import numpy as np
import pytest

from sim_server.service.wake import Wake
from tests.backends.fake_cuda import FakeScene
from tests.scenes import bar, simulation

LONG = 600.0  # s: a test that waited so long would fail by pytest's own limit


def is_set(wake: Wake) -> bool:
    return bool(select.select([wake.fd], [], [], 0)[0])


def test_a_wait_ends_when_it_is_set_before_or_meanwhile():
    wake = Wake()
    wake.set()
    wake.set()
    assert wake.wait(LONG) and not wake.wait(0), "once, however often it was set"
    waiter = threading.Thread(target=wake.wait, args=(LONG,))
    waiter.start()
    wake.set()
    waiter.join(60)
    assert not waiter.is_alive()


def test_a_rest_is_about_as_long_as_the_work_before_it_and_never_longer_than_the_most(monkeypatch):
    now, slept = [10.0], []
    monkeypatch.setattr("sim_server.service.wake.time.monotonic", lambda: now[0])
    monkeypatch.setattr("sim_server.service.wake.time.sleep", slept.append)
    wake = Wake()
    for worked in (0.25, 5.0, 0.0):
        wake.set()
        wake.rest(now[0] - worked, 1.0)
    assert slept == [0.25, 1.0]
    wake.rest(now[0] - 0.25, 0.0)  # not set
    assert slept == [0.25, 1.0]


def test_the_descriptor_is_closed_with_the_object():
    wake = Wake()
    path = Path(f"/proc/self/fd/{wake.fd}")
    assert os.readlink(path) == "anon_inode:[eventfd]"
    fd = wake.fd
    del wake
    with pytest.raises(OSError, match="Bad file descriptor"):
        os.eventfd_write(fd, 1)


def test_a_loop_writes_to_it_when_a_matrix_is_there():
    sim, wake = simulation(bar((3, 1, 1), fixed="X < 0.01"), gravity=(0, -9.81, 0)), Wake()
    sim.engine.loop.wake = wake.fd
    sim.engine.run(1)
    assert not is_set(wake), "nobody has asked for one"
    target = np.zeros(sim.system.values.shape)
    sim.engine.request_matrix(0, target)
    sim.engine.run(1)
    assert is_set(wake) and sim.engine.matrix_step(0) == 1 and target.any()


def test_the_loop_of_a_gpu_writes_to_it_once_the_matrix_has_reached_the_host():
    scene, wake, target = FakeScene(bodies=2), Wake(), np.zeros((2, 3, 3))
    scene.loop.loop.wake = wake.fd
    scene.loop.run(5)
    assert not is_set(wake)
    scene.loop.request_matrix(1, target)
    scene.loop.run(5)
    assert is_set(wake) and scene.loop.matrix_step(1) >= 5
