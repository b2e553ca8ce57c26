# SPDX-License-Identifier: MIT
"""Real worker processes: shared memory, death, restarts of either side, late answers."""

import contextlib
import logging
import os
import re
import signal
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from hand_worker import HandWorker
from link_helpers import Driver, chain, dense, light_worker, matrix, process, product

from protocol import messages_pb2 as pb
from protocol.refused import Refused
from protocol.shared_memory import limits as shm_limits
from protocol.shared_memory import probe as shm_probe
from protocol.shared_memory.pool import Slot
from sim_server.network import factor_intake, worker_choice
from sim_server.network.link import ServerLink
from sim_server.updates.factor_source import Job
from tests.ports import free_endpoint

pytestmark = pytest.mark.system
shared = pytest.mark.skipif(bool(shm_limits.obstacle()), reason=f"no shared memory here: {shm_limits.obstacle()}")

BEAM = chain()
LIVES = 20  # of workers one after another


def check(driver: Driver, step: int, shift: float, dtype: str = "float32") -> None:
    factor = driver.factor(BEAM, step, shift, dtype)
    tolerance = 1e-5 if dtype == "float32" else 1e-12
    assert factor.values.dtype == dtype
    assert np.allclose(product(factor), dense(BEAM, matrix(BEAM, shift)), atol=tolerance)


@shared
def test_matrices_and_factors_go_through_shared_memory() -> None:
    endpoint = free_endpoint()
    with ServerLink(listen=[endpoint]) as link, light_worker(endpoint):
        driver = Driver(link)
        link.announce(BEAM)
        for step in range(1, 6):
            check(driver, step, 0.1 * step, "float32" if step % 2 else "float64")
        driver.until(lambda: link.dispatch.workers() and link.dispatch.workers()[0].bulk_shared >= 5, "a heartbeat")
        worker = link.dispatch.workers()[0]
        assert worker.shared_memory
        # As the receivers saw it: every matrix, and every factor but the first, whose size nobody knew.
        assert (worker.bulk_shared, worker.bulk_copied) == (5, 0)
        assert (link.counters.bulk_shared, link.counters.bulk_copied) == (9, 1)
        assert link.counters.refused == 0 and driver.failures == []


@shared
def test_several_small_objects_wait_at_one_worker(monkeypatch: pytest.MonkeyPatch) -> None:
    """Jobs of all of them are in flight at once, and each factor is that of its own matrix."""
    monkeypatch.setattr(worker_choice, "QUEUE_SECONDS", 60.0)
    endpoint, names = free_endpoint(), [f"beam{k}" for k in range(12)]
    beams = [chain(object=name) for name in names]
    with ServerLink(listen=[endpoint]) as link, light_worker(endpoint):
        driver = Driver(link)
        for beam in beams:
            link.announce(beam)
        assert driver.factor(beams[0], 1).worker == "light"
        assert link.dispatch.ready() >= len(beams), "its factorizations take no minute, so it has room for all"
        for k, beam in enumerate(beams):
            assert link.dispatch.submit(Job(names[k], 1, 2, True, matrix(beam, 0.1 * k)))
        driver.until(lambda: len(driver.factors) == 1 + len(beams), "all factors")
        for factor in driver.factors[1:]:
            k = names.index(factor.object)
            assert np.allclose(product(factor), dense(beams[k], matrix(beams[k], 0.1 * k)), atol=1e-5)
        assert driver.failures == [] and link.counters.refused == 0
        large = chain(nodes=8000, object="large")
        link.announce(large)
        assert link.dispatch.ready() == 1, "beside a large object each waits for the one before"


def test_large_factors_are_decoded_beside_the_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    """All count as large here; while one is decoded, a second answer to its job is refused."""
    monkeypatch.setattr(factor_intake, "LARGE", 0)
    endpoint = free_endpoint()
    with ServerLink(listen=[endpoint]) as link, HandWorker(endpoint, link.incarnation) as hand:
        driver = Driver(link)
        link.announce(BEAM)
        hand.hello()
        driver.until(link.dispatch.ready, "the worker")
        driver.submit(BEAM, 1)
        answer, values = hand.right_answer(hand.receive(), BEAM)
        decoding, decode = threading.Event(), link.dispatch.decoder.decode
        woken = threading.Event()
        link.dispatch.wake_by(woken.set)

        def slow(*arguments: Any) -> Any:
            assert decoding.wait(30)
            return decode(*arguments)

        monkeypatch.setattr(link.dispatch.decoder, "decode", slow)
        hand.answer(answer, values)
        hand.answer(answer, values)
        driver.until(lambda: link.counters.refusals["duplicate"] == 1, "the second answer")
        assert driver.factors == [] and link.dispatch.ready() == 0 and not woken.is_set()
        decoding.set()
        assert woken.wait(60)
        driver.until(lambda: driver.factors, "the factor")
        assert np.allclose(product(driver.factors[0]), dense(BEAM, matrix(BEAM)), atol=1e-5)
        driver.submit(BEAM, 2)
        answer, values = hand.right_answer(hand.receive(), BEAM)
        hand.answer(answer, 2 * values)
        driver.until(lambda: driver.failures, "the spoiled one")
        assert "was refused" in driver.failures[0][1] and len(driver.factors) == 1


@shared
def test_a_worker_without_shared_memory_gets_bytes_and_that_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    endpoint = free_endpoint()
    with caplog.at_level(logging.WARNING), ServerLink(listen=[endpoint]) as link:
        driver = Driver(link)
        link.announce(BEAM)
        for name in ("one", "two"):
            with light_worker(endpoint, name, "no-shm"):
                for step in range(1, 4):
                    driver.factors.clear()
                    check(driver, step, 0.1 * step)
            driver.until(lambda: not link.dispatch.workers(), "the worker to leave")
        assert (link.counters.bulk_shared, link.counters.bulk_copied) == (0, 12)
    warnings = [record.message for record in caplog.records if "arrays are copied" in record.message]
    assert len(warnings) == 1 and "worker one has no shared memory with us" in warnings[0]


@shared
def test_shared_memory_comes_back_after_a_server_that_was_too_busy_to_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    endpoint, asked = free_endpoint(), []
    with ServerLink(listen=[endpoint]) as link:
        answer = shm_probe.answer

        def busy(slot: Slot, question: pb.Echo, incarnation: int) -> tuple[pb.Echo, zenoh.ZBytes]:
            asked.append(question)
            if len(asked) <= 2:
                raise Refused("busy", "limit")
            return answer(slot, question, incarnation)

        monkeypatch.setattr(shm_probe, "answer", busy)
        with light_worker(endpoint):
            driver = Driver(link)
            link.announce(BEAM)
            check(driver, 1, 0.1)
            assert not link.dispatch.workers()[0].shared_memory and link.counters.bulk_shared == 0
            driver.until(lambda: link.dispatch.workers()[0].shared_memory, "the status to say so")
            for step in range(2, 5):
                check(driver, step, 0.1 * step)
            assert link.counters.bulk_shared == 6 and len(asked) >= 4


def test_a_server_without_shared_memory_sends_bytes() -> None:
    endpoint = free_endpoint()
    with ServerLink(listen=[endpoint], shared_memory=False) as link, light_worker(endpoint):
        driver = Driver(link)
        link.announce(BEAM)
        for step in range(1, 4):
            check(driver, step, 0.1 * step)
        assert not link.dispatch.workers()[0].shared_memory
        assert (link.counters.bulk_shared, link.counters.bulk_copied) == (0, 6)


def test_killed_with_a_job_in_hand_and_started_again() -> None:
    endpoint = free_endpoint()
    with ServerLink(listen=[endpoint]) as link:
        driver = Driver(link)
        link.announce(BEAM)
        with light_worker(endpoint, "mortal", "slow=0.01"):
            check(driver, 1, 0.0)
        driver.until(lambda: not link.dispatch.workers(), "the worker to leave")
        with light_worker(endpoint, "mortal", "slow=1000") as child:
            driver.submit(BEAM, 2)
            driver.until(lambda: link.dispatch.workers()[0].jobs == 1, "the job to be in hand")
            os.kill(child.pid, signal.SIGKILL)
            driver.until(lambda: driver.failures, "the loss to be seen")
            assert driver.failures == [("beam", "factorization of beam at step 2 was lost with worker mortal")]
            assert link.dispatch.workers() == [] and not link.dispatch.ready()
            assert link.slots_lent == 0
        with light_worker(endpoint, "mortal"):
            check(driver, 3, 0.3)
        assert link.counters.jobs_lost == 1 and link.counters.refused == 0


def test_an_object_whose_worker_died_goes_to_another() -> None:
    endpoint = free_endpoint()
    with ServerLink(listen=[endpoint]) as link:
        driver = Driver(link)
        link.announce(BEAM)
        with light_worker(endpoint, "hung", "slow=1000") as hung:
            driver.submit(BEAM, 1)
            with light_worker(endpoint, "good"):
                driver.until(lambda: len(link.dispatch.workers()) == 2, "two workers")
                os.kill(hung.pid, signal.SIGKILL)
                driver.until(lambda: driver.failures, "the loss to be seen")
                check(driver, 2, 0.2)
                assert driver.factors[-1].worker == "good"


def test_a_late_worker_keeps_its_slots_and_its_answer_is_refused() -> None:
    endpoint, now = free_endpoint(), [0.0]
    with (
        ServerLink(listen=[endpoint], clock=lambda: now[0]) as link,
        HandWorker(endpoint, link.incarnation) as hand,
        light_worker(endpoint, "other"),
    ):
        driver = Driver(link)
        link.announce(BEAM)
        driver.until(link.dispatch.ready, "the other worker")
        check(driver, 1, 0.0)
        driver.until(lambda: link.dispatch.workers()[0].jobs == 1, "a heartbeat")
        now[0] += 1.5
        hand.shared_memory = True  # it claims so, to be lent slots
        hand.hello()
        driver.until(lambda: len(link.dispatch.workers()) == 2, "both workers")
        driver.submit(chain(object="beam"), 2)  # goes to who knows the object, so occupy that one first
        driver.until(lambda: [f for f in driver.factors if f.step == 2], "the factor of step 2")
        link.announce(chain(object="bar"))
        driver.submit(chain(object="bar"), 1)
        job = hand.receive()
        lent = link.slots_lent
        answer, values = hand.right_answer(job, chain(object="bar"))
        now[0] += 130.0  # the lease is over
        driver.until(lambda: driver.failures, "the lease to be over")
        assert "not answered within its lease" in driver.failures[0][1]
        assert link.slots_lent == lent > 0
        hand.answer(answer, values)
        driver.until(lambda: link.counters.refusals["late"] == 1, "the late answer")
        assert link.slots_lent == 0
        assert not [f for f in driver.factors if f.object == "bar"]
        hand.hello()
        driver.until(lambda: len(link.dispatch.workers()) == 2, "both workers again")
        driver.submit(chain(object="bar"), 2)


@shared
def test_a_late_write_into_a_slot_lent_again_is_noticed() -> None:
    endpoint = free_endpoint()
    with (
        ServerLink(listen=[endpoint], silence=60) as link,
        HandWorker(endpoint, link.incarnation, shared_memory=True) as hand,
    ):
        driver = Driver(link)
        link.announce(BEAM)
        hand.hello()
        driver.submit(BEAM, 1)
        answer, values = hand.right_answer(hand.receive(), BEAM)
        hand.answer(answer, values)
        driver.until(lambda: driver.factors, "the first factor, as bytes")
        from protocol.shared_memory.view import SlotMap

        slots = SlotMap()

        def through_slot(step: int, late: bool, generation: int = 0) -> None:
            driver.submit(BEAM, step)
            job = hand.receive()
            answer, values = hand.right_answer(job, BEAM)
            target = slots.array(job.factor_slot, np.float32, len(values))
            target[:] = values
            if late:
                target[3] += 1  # what another worker wrote there, which had the slot before
            answer.slot.CopyFrom(job.factor_slot)
            answer.slot.generation -= generation
            hand.answer(answer)

        through_slot(2, late=False)
        driver.until(lambda: len(driver.factors) == 2, "the factor in the slot")
        through_slot(3, late=True)
        driver.until(lambda: link.counters.refusals["checksum"] == 1, "the refusal")
        through_slot(4, late=False, generation=1)
        driver.until(lambda: link.counters.refusals["slot"] == 1, "the refusal of another generation")
        through_slot(5, late=False)
        driver.until(lambda: driver.factors[-1].step == 5, "a good factor again")
        assert [factor.step for factor in driver.factors] == [1, 2, 5]


def test_the_server_starts_again_under_a_living_worker() -> None:
    endpoint = free_endpoint()
    with light_worker(endpoint) as child:
        incarnations, pids = set(), set()
        for life in range(3):
            with ServerLink(listen=[endpoint]) as link:
                driver = Driver(link)
                incarnations.add(link.incarnation)
                topology = chain(6 + life)  # the same object and epoch, another mesh
                link.announce(topology)
                factor = driver.factor(topology, 1, 0.1)
                assert np.allclose(product(factor), dense(topology, matrix(topology, 0.1)), atol=1e-5)
                pids.add(link.dispatch.workers()[0].pid)
        assert len(incarnations) == 3 and pids == {child.pid}


def test_a_worker_that_stops_answering_gets_no_more_jobs_and_may_come_back() -> None:
    endpoint = free_endpoint()
    with ServerLink(listen=[endpoint], silence=0.6) as link, light_worker(endpoint) as child:
        driver = Driver(link)
        link.announce(BEAM)
        check(driver, 1, 0.0)
        os.kill(child.pid, signal.SIGSTOP)
        driver.until(lambda: not link.dispatch.workers() and not link.dispatch.ready(), "the silence to be noticed")
        os.kill(child.pid, signal.SIGCONT)
        driver.until(link.dispatch.ready, "the worker to be back")
        check(driver, 2, 0.2)


def test_new_epochs_bring_new_patterns() -> None:
    endpoint = free_endpoint()
    with ServerLink(listen=[endpoint]) as link, light_worker(endpoint):
        driver = Driver(link)
        for epoch, nodes in ((1, 5), (2, 7), (3, 4)):
            topology = chain(nodes, epoch=epoch)
            link.announce(topology)
            for step in range(10 * epoch, 10 * epoch + 3):
                factor = driver.factor(topology, step, 0.5)
                assert factor.epoch == epoch and factor.pattern.size == 3 * nodes
                assert np.allclose(product(factor), dense(topology, matrix(topology, 0.5)), atol=1e-5)
        assert link.counters.refused == 0


def test_a_matrix_that_cannot_be_factorized_is_reported() -> None:
    endpoint = free_endpoint()
    with ServerLink(listen=[endpoint]) as link, light_worker(endpoint):
        driver = Driver(link)
        link.announce(BEAM)
        driver.submit(BEAM, 1, shift=-10.0)
        driver.until(lambda: driver.failures, "the failure")
        assert "not positive definite" in driver.failures[0][1]
        check(driver, 2, 0.0)


def test_several_workers_and_objects() -> None:
    endpoint = free_endpoint()
    topologies = {name: chain(4 + k, name) for k, name in enumerate(("a", "b", "c", "d", "e"))}
    with ServerLink(listen=[endpoint]) as link, light_worker(endpoint, "w1"), light_worker(endpoint, "w2"):
        driver = Driver(link)
        for topology in topologies.values():
            link.announce(topology)
        driver.until(lambda: len(link.dispatch.workers()) == 2, "both workers")
        for step in range(1, 4):
            for topology in topologies.values():
                driver.submit(topology, step, 0.1 * step)
        driver.until(lambda: len(driver.factors) == 15, "15 factors")
        for factor in driver.factors:
            topology = topologies[factor.object]
            assert np.allclose(product(factor), dense(topology, matrix(topology, 0.1 * factor.step)), atol=1e-5)
        assert {factor.worker for factor in driver.factors} == {"w1", "w2"}
        assert driver.failures == [] and link.counters.refused == 0


def locked_kib() -> int:
    status = Path("/proc/self/status").read_text().splitlines()
    return int(next(line.split()[1] for line in status if line.startswith("VmLck:")))


def segments_of(process: str) -> set[str]:
    """zenoh's files in /dev/shm that a process maps; empty if it has gone. process: its number, or * for any."""
    found: set[str] = set()
    for maps in Path("/proc").glob(f"{process}/maps"):
        with contextlib.suppress(OSError):
            found.update(re.findall(rf"{shm_limits.SHM}/(\d+\.zenoh)", maps.read_text()))
    return found


@shared
@pytest.mark.slow
def test_workers_one_after_another_leak_nothing() -> None:
    endpoint, used = free_endpoint(), set()
    with ServerLink(listen=[endpoint]) as link:
        driver = Driver(link)
        link.announce(BEAM)
        locked = []
        for life in range(LIVES):
            with light_worker(endpoint, f"w{life}" if life % 2 else "same") as child:
                driver.factors.clear()
                check(driver, life + 1, 0.1)
                if life % 3 == 0:
                    driver.submit(BEAM, 1000 + life)
                used |= segments_of(str(child.pid))
                os.kill(child.pid, signal.SIGKILL if life % 2 else signal.SIGTERM)
            driver.until(lambda: not link.dispatch.workers(), "the worker to leave")
            driver.until(lambda: link.slots_lent == 0, "its slots")
            locked.append(locked_kib())
        # The first lives make the slots that the others use again.
        assert locked[-1] <= locked[3], locked
    assert len(used) >= LIVES, "each life had one of its own"
    left = {path.name for path in shm_limits.SHM.glob("*.zenoh")} & used - segments_of("[0-9]*")
    assert len(left) <= 1  # zenoh sweeps up after the dead when the next process starts


def test_time_passes_for_leases_only_while_somebody_looks() -> None:
    """Nothing but the service thread moves the books: a pause of it loses no worker that is alive."""
    endpoint = free_endpoint()
    with ServerLink(listen=[endpoint], silence=0.5) as link, light_worker(endpoint):
        driver = Driver(link)
        link.announce(BEAM)
        check(driver, 1, 0.0)
        time.sleep(1.0)
        assert [worker.worker for worker in link.dispatch.workers()] == ["light"]
        check(driver, 2, 0.0)


def test_the_real_worker_factorizes() -> None:
    endpoint = free_endpoint()
    with (
        ServerLink(listen=[endpoint]) as link,
        process("-m", "precond_worker", "--connect", endpoint, "--name", "real") as child,
    ):
        driver = Driver(link)
        link.announce(BEAM)
        for step in range(1, 4):
            check(driver, step, 0.1 * step, "float64")
        assert child.stdout is not None
        line = child.stdout.readline()
        assert line.startswith("precond-worker real ready: ") and endpoint in line
        child.send_signal(signal.SIGTERM)
        assert child.wait(20) == 0
        driver.until(lambda: not link.dispatch.workers(), "the worker to leave")
