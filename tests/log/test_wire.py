# SPDX-License-Identifier: MIT
"""Messages of many steps, encoded at once: what protobuf's own library reads in them."""

import math

import numpy as np
import pytest
from google.protobuf.descriptor import FieldDescriptor

from protocol import messages_pb2 as pb
from sim_server.backends.cpu.structs import RECORD
from sim_server.backends.kinds import Kind
from sim_server.backends.reused_memory import ReusedMemory
from sim_server.backends.ring_buffers import part_of_ring
from sim_server.recording import messages, wire
from sim_server.recording.object_steps import COPIED, KNOWN, OPTIONAL, Additions, Reactions
from sim_server.simulation import Simulation
from tests.scenes import bar, simulation

WHOLE = (0, 1, 127, 128, 1 << 14, (1 << 31) - 1)  # of int32, and their varints of one byte to five
REAL = (0.0, -0.0, 1.0, -1e-300, math.inf, 1e308, math.nan)


def two() -> Simulation:
    return simulation(bar(name="a"), bar(name="b"), preconditioner="cholesky")


def strange(count: int = 200) -> np.ndarray:
    """Records of any numbers that their columns may hold."""
    rng, records = np.random.default_rng(1), np.zeros(count, RECORD)
    for name in RECORD.names or ():
        flag = name in COPIED and KNOWN[COPIED[name]].type == FieldDescriptor.TYPE_BOOL
        values = REAL if RECORD[name].kind == "f" else (0, 1) if flag else WHOLE
        records[name] = rng.choice(values, count)
    records["step"] = rng.choice([1, 1 << 40, (1 << 63) - 1], count)
    records["factor_step"] = rng.choice([-1, 0, 5, 1 << 40], count)
    records["body"], records["status"] = rng.integers(0, 2, count), rng.integers(0, 8, count)
    records["kind"], records["asked"] = (rng.choice([int(k) for k in Kind], count) for _ in range(2))
    records["form"] = rng.integers(0, 3, count)
    records["nonlinear"] = rng.choice([-1.0, 0.0, 0.5], count)
    return records


def same(a: float, b: float) -> bool:
    return (a == b and math.copysign(1, a) == math.copysign(1, b)) or (math.isnan(a) and math.isnan(b))


def test_every_column_arrives_as_it_was():
    sim, records = two(), strange()
    excess = np.linspace(0, 7, len(records))
    made = messages.encoded_steps(sim, records, excess=excess, age_bound=9)
    names = messages.preconditioner_names(sim)
    for r, encoded, told in zip(records, made, excess, strict=True):
        step = pb.ObjectStep.FromString(encoded.data)
        assert (encoded.object, encoded.step) == (step.header.object, step.step) == ("ab"[r["body"]], r["step"])
        assert same(encoded.time, float(r["time"])) and step.header.epoch == 1
        searched = r["nonlinear"] != -1
        for column, field in COPIED.items():
            value = r[column].item() if searched or column not in ("nonlinear", "linearizations") else 0
            if field in OPTIONAL:
                assert step.HasField(field) == (value == value), field
            if field not in OPTIONAL or value == value:
                assert same(float(getattr(step, field)), float(value)), field
        with np.errstate(all="ignore"):
            dissipated = float(r["budget"] - r["kinetic"] - r["elastic"])
        assert step.HasField("dissipated") == (dissipated == dissipated)
        if dissipated == dissipated:
            assert step.dissipated == dissipated
        assert step.factor_age == (r["step"] - 1 - r["factor_step"] if r["factor_step"] >= 0 else -1)
        used, asked = names[Kind(r["kind"])], names[Kind(r["asked"])]
        assert (step.preconditioner, step.asked) == (used, "" if used == asked else asked)
        assert (step.excess, step.factor_age_bound) == (told, 9)


def test_they_are_as_long_as_those_of_the_library():
    """What is 0 is left out, as readers of other languages expect it; so logs grow by nothing."""
    sim, records = two(), strange()
    for encoded in messages.encoded_steps(sim, records):
        assert len(encoded.data) == len(pb.ObjectStep.FromString(encoded.data).SerializeToString())


def test_what_is_added_goes_to_its_record():
    sim, records = two(), np.zeros(6, RECORD)
    records["step"], records["body"] = [1, 1, 2, 2, 3, 3], [0, 1] * 3
    on = np.zeros((6, 1, 6))
    on[3, 0, 1] = 2.5
    additions = Additions()
    additions[4].interactions.add(id=7)
    reactions = Reactions(on, np.zeros(0), ["floor"], ["a", "b"])
    made = messages.encoded_steps(sim, records, reactions=reactions, additions=additions)
    steps = [pb.ObjectStep.FromString(each.data) for each in made]
    assert [[(r.obstacle, r.force.y) for r in step.reactions] for step in steps] == [
        [],
        [],
        [],
        [("floor", 2.5)],
        [],
        [],
    ]
    assert [[i.id for i in step.interactions] for step in steps] == [[], [], [], [], [7], []]
    assert [step.step for step in steps] == [1, 1, 2, 2, 3, 3]
    del steps[4].interactions[:]
    assert steps == messages.steps(sim, records, reactions=reactions)


def test_none_is_none():
    assert messages.encoded_steps(two(), np.zeros(0, RECORD)) == []


@pytest.mark.parametrize("size", [0, 1, 127, 128, 20_000])
def test_messages_become_the_values_of_a_repeated_field(size):
    steps = [pb.ObjectStep(header=pb.Header(object="x" * size), step=k) for k in range(3)]
    data = wire.repeated(pb.Steps.STEPS_FIELD_NUMBER, [step.SerializeToString() for step in steps])
    assert pb.Steps.FromString(data) == pb.Steps(steps=steps)


def test_fields_that_are_told_are_those_of_the_message():
    assert set(COPIED.values()) <= set(KNOWN) and {"step", "time", "residual", "cpu_seconds"} <= set(COPIED.values())


@pytest.mark.parametrize("kind", [RECORD, np.dtype("f8")])
def test_a_part_of_a_ring_is_what_an_index_array_gives(kind):
    rng, memory = np.random.default_rng(0), ReusedMemory()
    ring = rng.integers(0, 255, 7 * kind.itemsize, np.uint8).view(kind)
    for tail in range(20):
        for count in range(8):
            found = part_of_ring(ring, tail, tail + count, memory)
            assert (
                found.tobytes() == ring[np.arange(tail, tail + count) % 7].tobytes()[: found.nbytes] or kind is RECORD
            )
            for name in kind.names or ():
                np.testing.assert_array_equal(found[name], ring[name][np.arange(tail, tail + count) % 7])
    assert part_of_ring(np.zeros((5, 0, 6)), 3, 8, memory).shape == (5, 0, 6)
