# SPDX-License-Identifier: MIT
"""The records that a GPU writes into the ring of the host (step_records.cu), run by threads of the processor."""

import ctypes as c

import numpy as np
import pytest

from protocol import messages_pb2 as pb
from sim_server.backends.cpu.structs import RECORD
from sim_server.backends.gpu.loop import CAPACITY
from sim_server.backends.gpu.structs import ENERGY_RECORD, PCG_RESULT, RECORD_TARGET, GpuLoop
from tests.backends.fake_cuda import write_records

HOST = ("step", "time", "whole", "late", "begin", "cpu", "body")  # of the loop, which knows them
SAME = ("factor_step", "residual", "iterations", "asked", "fallbacks", "bad_node", "probe", "at_rest")
WELL, AWAY, FROZEN = range(3)


class Ring:
    """Random results of all steps that the device keeps, and a ring for `room` records, whose bytes are all 255."""

    def __init__(self, bodies: int, room: int):
        rng = np.random.default_rng(bodies)
        self.bodies, self.room = bodies, room
        self.results = np.zeros((CAPACITY, bodies), PCG_RESULT)
        self.energies = np.zeros((CAPACITY, bodies), ENERGY_RECORD)
        for array in (self.results, self.energies):
            for name in array.dtype.names:
                whole = array.dtype[name].kind == "i"
                array[name] = rng.integers(1, 99, array.shape) if whole else rng.random(array.shape)
        self.results["status"], self.energies["phase"] = pb.CONVERGED, WELL
        self.memory = np.full(room * RECORD.itemsize, 255, np.uint8)
        self.loop = GpuLoop(records=self.memory.ctypes.data, record_capacity=room)

    def write(self, first: int, steps: int, place: int, blocks: int = 2) -> np.ndarray:
        """The records of so many steps from `first` on, by step and body."""
        target = np.array([(first, steps, place)], RECORD_TARGET)
        write_records(self.results, self.energies, self.loop, target.ctypes.data, blocks)
        at = (place + np.arange(steps * self.bodies)) % self.room
        return self.memory.view(RECORD)[at].reshape(steps, self.bodies)


@pytest.mark.parametrize(("bodies", "steps", "blocks"), [(1, 1, 1), (1, 16, 4), (5, 13, 2), (64, 2, 1), (70, 3, 3)])
def test_records_have_the_results_of_their_steps_and_bodies(bodies, steps, blocks):
    ring = Ring(bodies, 260)
    first, place = 3 * CAPACITY - 2, 10 * 260 - 7  # both rings go round meanwhile
    records = ring.write(first, steps, place, blocks)
    slots = (first + np.arange(steps)) % CAPACITY
    solves, energies = ring.results[slots], ring.energies[slots]
    for name in SAME:
        assert (records[name] == solves[name]).all(), name
    assert (records["solve"] == solves["seconds"]).all() and (records["solve_error"] == solves["solve_error"]).all()
    for name in ("kinetic", "elastic", "gravity", "work", "budget", "stride"):
        assert (records[name] == energies[name]).all(), name
    assert (records["linearizations"] == 1).all() and (records["nonlinear"] == -1).all()
    assert np.isnan(records["step_error"]).all() and np.isnan(records["contact_residual"]).all()
    others = np.delete(np.arange(ring.room), (place + np.arange(steps * bodies)) % ring.room)
    assert (ring.memory.reshape(ring.room, -1)[others] == 255).all()


def test_the_numbers_of_thread_blocks_do_not_matter():
    few, many = Ring(33, 300), Ring(33, 300)
    few.write(5, 7, 4, 1)
    many.write(5, 7, 4, 64)
    assert few.memory.tobytes() == many.memory.tobytes()


def test_nothing_is_written_where_nothing_is_asked_for():
    ring = Ring(3, 20)
    ring.write(5, 0, -1)
    assert (ring.memory == 255).all()


def test_bodies_that_ran_away_say_so_and_rest_without_a_factor():
    ring = Ring(6, 20)
    slot = 8
    ring.results["factor_step"], ring.results["asked"], ring.results["kind"] = 7, 3, 2
    ring.energies["phase"][slot] = [WELL, AWAY, FROZEN, FROZEN, AWAY, FROZEN]
    ring.energies["found"][slot] = [0, 1, 1, 0, 1, 1]
    ring.results["status"][slot] = [pb.CONVERGED, *(pb.CONVERGED,) * 3, pb.NOT_FINITE, pb.NOT_FINITE]
    (records,) = ring.write(slot, 1, 0)
    told = [pb.CONVERGED, pb.RUNAWAY, pb.RUNAWAY, pb.RUNAWAY, pb.NOT_FINITE, pb.NOT_FINITE]
    assert records["status"].tolist() == told  # not_finite says more
    assert records["factor_step"].tolist() == [7, 7, 7, -1, 7, 7] and records["kind"].tolist() == [2, 2, 2, 3, 2, 2]


def test_the_loop_writes_the_first_members():
    """In one piece, while those behind it stay as the device has written them."""
    assert RECORD.names[: len(HOST)] == HOST
    assert c.sizeof(c.c_int64) * 6 + 4 == RECORD.fields["iterations"][1]
