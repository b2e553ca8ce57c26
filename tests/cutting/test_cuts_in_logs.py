# SPDX-License-Identifier: MIT
"""Each frame of a log has its mesh there, however slow the disk is."""

import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clients.log.reader import Log
from sim_server.explain.topics import NotedLink
from sim_server.recording.mcap_file import McapFile
from sim_server.recording.recorder import Recorder
from sim_server.service.telemetry import Telemetry
from sim_server.updates.driver import Driver
from tests.cutting.cut_scenes import cut, made


@pytest.fixture
def disk(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """Set: it writes."""
    writes, write = threading.Event(), McapFile.write
    writes.set()

    def waiting(self: McapFile, *record: Any) -> None:
        assert writes.wait(60)
        write(self, *record)

    monkeypatch.setattr(McapFile, "write", waiting)
    return writes


def test_a_cut_that_a_slow_disk_has_no_room_for_comes_with_the_next_frame(tmp_path: Path, disk: Any) -> None:
    sim = made(record={"every": 1})
    driver, path = Driver(sim), tmp_path / "run.mcap"
    recorder = Recorder(path, report=lambda _: None, frame_bytes=20_000, total_bytes=20_000)
    telemetry = Telemetry(driver, NotedLink("sim"), recorder, patient=False)
    telemetry.open()
    sim.engine.loop.frame_every = 1

    def steps(count: int) -> None:
        for _ in range(count):
            driver.advance(1)
            telemetry.frames()

    steps(1)
    disk.clear()
    steps(12)  # the queue is full
    dropped = recorder.dropped
    assert dropped > 0
    first = cut(sim, "X > 1.7")
    steps(2)
    second = cut(sim, "X > 1.5")
    steps(2)
    assert recorder.dropped == dropped + 4 and recorder.lost == 0
    disk.set()
    while not telemetry.cuts.written("bar", sim.engine.step):  # there is no room yet
        time.sleep(0.001)
    for _ in range(3):
        written = recorder.written
        steps(1)
        while recorder.written == written:
            time.sleep(0.001)
    recorder.close()
    assert recorder.lost == 0
    with Log(path) as log:
        frames = list(log.frames("bar"))
        assert [frame.step for frame in frames][-3:] == [18, 19, 20]
        meshes = [log.mesh("bar", frame.epoch) for frame in frames]
        tets = len(sim.world.bodies[0].mesh.tets)
        assert len(meshes[0].tets) == tets and len(meshes[-1].tets) == tets - len(np.union1d(first, second))
        assert len(log.objects["bar"].meshes) == 2, "without that of no frame"
