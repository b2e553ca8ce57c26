# SPDX-License-Identifier: MIT
"""Device memory that a server shares with workers beside it: who opens it, who dies, and that factors are the same."""

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from precond_worker.factorization.modified_cholesky import ModifiedCholesky
from protocol.refused import Refused
from protocol.validate import checksum
from sim_server.backends.shared_memory import PlacedMatrix
from sim_server.network.device_slots import DeviceSlot, DeviceSlots
from tests.gpu.opens_memory import COUNT
from tests.system.link_helpers import process
from tests.system.server_process import Stage, beam, run, until
from tests.worker.block_matrices import bar_edges, pattern, spd

pytestmark = pytest.mark.gpu
OPENS = str(Path(__file__).with_name("opens_memory.py"))
LARGE = (8, 8, 30)  # cells of a beam whose factor has more than a MiB
GRAPH = pattern(4 * 4 * 11, bar_edges(3, 3, 10), np.arange(16))


@pytest.fixture(scope="module")
def gpu():
    from sim_server.backends.gpu.device import Gpu
    from sim_server.errors import DeviceError

    try:
        return Gpu()
    except DeviceError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def slots(gpu) -> DeviceSlots:
    from sim_server.backends.gpu.shared_device_memory import SharedDeviceMemory

    made = DeviceSlots(SharedDeviceMemory(gpu))
    if not made.usable:
        pytest.skip("this driver shares no device memory")
    return made


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    made = Stage(tmp_path)
    yield made
    made.close()


def lent(slots: DeviceSlots, *sizes: int) -> list[DeviceSlot]:
    found: list[DeviceSlot] = []
    until(lambda: found.extend(slots.lend(sizes) or ()) or found, "slots are there")
    for slot in found:
        slots.mark(slot, slot.generation)
    return found


@contextmanager
def opener(slot: DeviceSlot, *what: str) -> Iterator[subprocess.Popen[str]]:
    with process(OPENS, slot.handle.hex(), str(slot.capacity), str(slot.generation), *what) as child:
        yield child


def floats(slots: DeviceSlots, slot: DeviceSlot) -> np.ndarray:
    return slots.memory.read(slot.address, COUNT // 2).view(np.float32)


def line(child: subprocess.Popen[str]) -> str:
    assert child.stdout is not None
    return child.stdout.readline().strip()


def test_another_process_reads_and_writes_it_and_takes_nothing_away_when_it_is_killed(slots: DeviceSlots) -> None:
    (slot,) = lent(slots, 4 * COUNT)
    slots.memory.write(slot.address, np.full(COUNT, 1.5, np.float32).view(np.uint64))
    with opener(slot, "fill", "2.5") as child:
        assert line(child) == "True 1.5"
        assert line(child) == "written"
        assert (floats(slots, slot) == 2.5).all()
        os.kill(child.pid, signal.SIGKILL)  # while it writes
        child.wait()
    time.sleep(0.2)
    assert (floats(slots, slot) == 2.5).all()
    with opener(slot, "open") as child:
        assert line(child) == "True 2.5"
    slots.give_back(slot)
    slots.mark(slot, slot.generation + 1)
    with opener(slot, "open") as child:
        assert line(child) == "False 2.5", "it was lent again"


def test_what_is_no_handle_or_too_small_is_refused_and_the_worker_goes_on(slots: DeviceSlots) -> None:
    (slot,) = lent(slots, 4 * COUNT)
    with opener(slot, "try") as child:
        found = [line(child) for _ in range(6)]
    assert [each.partition(":")[0] for each in found] == ["slot"] * 5 + ["opened"], found
    assert "63 bytes" in found[0] and "allocated" in found[3] and "needed" in found[4]
    slots.give_back(slot)


def test_slots_are_whole_pages_of_the_driver_of_their_own(slots: DeviceSlots) -> None:
    two = lent(slots, 1000, 1000)
    assert len({slot.handle for slot in two}) == 2
    assert all((slot.capacity + 256) % (2 << 20) == 0 for slot in two)
    for slot in two:
        slots.give_back(slot)


def test_a_factor_is_copied_and_checked(slots: DeviceSlots) -> None:
    analysis = Analysis(*GRAPH)
    values = analysis.factorize(spd(*GRAPH, seed=1), np.float32)
    (slot,) = lent(slots, values.nbytes + 4)
    memory, shape = slots.memory, analysis.pattern

    def put(given: np.ndarray) -> None:
        memory.write(slot.address, np.append(given, np.zeros(len(given) % 2, np.float32)).view(np.uint64))

    put(values)
    taken = memory.take(slot.address, shape, np.dtype(np.float32))
    for place, value, kind in ((7, np.nan, "not_finite"), (9, -np.inf, "not_finite"), (0, 0.0, "not_positive")):
        bad = values.copy()
        bad[shape.diagonal[3] if kind == "not_positive" else place] = value
        put(bad)
        with pytest.raises(Refused) as refusal:
            memory.take(slot.address, shape, np.dtype(np.float32))
        assert refusal.value.kind == kind
    np.testing.assert_array_equal(np.asarray(taken), values)  # of its own, whatever came after
    assert len(taken) == shape.nonzeros and taken.nbytes == values.nbytes
    put(values)
    for sums in (False, True):
        memory.sums = sums
        assert memory.take(slot.address, shape, np.dtype(np.float32)).checksum() == checksum(values)
    slots.give_back(slot)


def test_a_worker_makes_the_same_factor_on_the_device_as_through_the_host(slots: DeviceSlots) -> None:
    made, matrix = ModifiedCholesky(*GRAPH, "gpu"), spd(*GRAPH, seed=2)
    expected = made.factorize(matrix, np.float32).reshape(-1)
    source, target = lent(slots, matrix.nbytes, expected.nbytes)
    slots.memory.put(source.address, [PlacedMatrix(matrix, 0)])
    copy = made.factorize_on_device(source.address, np.float32)
    assert copy is not None
    copy(target.address)
    taken = slots.memory.take(target.address, made.pattern, np.dtype(np.float32))
    np.testing.assert_array_equal(np.asarray(taken), expected)
    with_nan = matrix.copy()
    with_nan[3] = np.nan
    for bad in (-matrix, with_nan):
        slots.memory.put(source.address, [PlacedMatrix(bad, 0)])
        assert made.factorize_on_device(source.address, np.float32) is None
    for slot in (source, target):
        slots.give_back(slot)


def on_device(client: Any) -> int:
    return int(client.status().bulk_on_device)


def test_factors_of_a_server_stay_on_its_gpu(stage: Stage, tmp_path: Path) -> None:
    stage.server(beam(tmp_path, LARGE), "--device", "gpu", "--workers", "1", "--worker-device", "gpu")
    with stage.client() as client:
        until(lambda: on_device(client) > 20, "arrays stay on the device")
        status = client.status()
        assert status.refused == 0 and status.objects[0].factors_refused == 0 and status.workers[0].failures == 0
        until(lambda: client.status().objects[0].last.iterations < 12, "factors are of use")


@pytest.mark.timeout(600)
def test_a_run_whose_factors_stayed_on_its_gpu_repeats_bit_for_bit(stage: Stage, tmp_path: Path) -> None:
    """The replay makes the factors in its own process, and brings them to the device from the host."""
    log = tmp_path / "run.mcap"
    server = stage.server(
        beam(tmp_path, LARGE), "--device", "gpu", "--workers", "1", "--worker-device", "gpu", "--record", str(log)
    )
    with stage.client() as client:
        until(lambda: on_device(client) > 20, "arrays stay on the device")
    assert server.end() == 0, server.output()
    result = run("clients", "replay", str(log), "--simulate", "--json", timeout=300)
    found = json.loads(result.stdout)
    assert result.returncode == 0 and found["same"] and found["other_factor"] is None and not found["notes"], found


def test_a_worker_that_is_killed_is_replaced_and_memory_is_shared_with_the_next(stage: Stage, tmp_path: Path) -> None:
    stage.server(beam(tmp_path, LARGE), "--device", "gpu", "--workers", "1", "--worker-device", "gpu")
    with stage.client() as client:
        for _ in range(3):
            before = on_device(client)
            until(lambda b=before: on_device(client) > b + 4, "arrays stay on the device")
            os.kill(client.status().local_workers[0].pid, signal.SIGKILL)
        before = on_device(client)
        until(lambda: on_device(client) > before + 4, "arrays stay on the device again")
        assert client.status().state == "running"


def test_without_shared_memory_arrays_travel_as_bytes(stage: Stage, tmp_path: Path) -> None:
    stage.server(beam(tmp_path, LARGE), "--device", "gpu")
    stage.worker("far", "--device", "gpu", "--no-shared-memory")
    with stage.client() as client:
        until(lambda: client.status().objects[0].factors_used > 4, "factors are taken up")
        assert on_device(client) == 0 and not client.status().workers[0].device_memory


def test_a_server_that_ends_leaves_its_worker_to_the_next_one(stage: Stage, tmp_path: Path) -> None:
    scene = beam(tmp_path, LARGE)
    first = stage.server(scene, "--device", "gpu")
    worker = stage.worker("w1", "--device", "gpu")
    with stage.client() as client:
        until(lambda: on_device(client) > 4, "arrays stay on the device")
    first.process.send_signal(signal.SIGKILL)
    until(lambda: "is gone" in worker.output(), "the worker has seen its server go")
    stage.server(scene, "--device", "gpu")
    with stage.client() as client:
        until(lambda: on_device(client) > 4, "arrays stay on the device of the next server")
    assert worker.process.poll() is None
