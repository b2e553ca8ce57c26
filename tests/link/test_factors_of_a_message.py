# SPDX-License-Identifier: MIT
"""Factors that come in one message are copied together, and each is judged by itself."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from protocol.channels import PROTOCOL
from protocol.factor import Factor
from protocol.messages_pb2 import Header, Topology
from protocol.refused import Refused
from protocol.validate import checksum
from sim_server.network import batch_decoder as module
from tests.support.answered_batch import GRAPHS, KINDS, MADE, ROOM, answered


@pytest.fixture
def stage() -> SimpleNamespace:
    return answered()


def refused(stage: SimpleNamespace) -> dict[str, str]:
    """Kinds of refusals by object; the others must have their own values."""
    kinds = {}
    found = decoded(stage)
    for job, each in zip(stage.batch.jobs, found, strict=True):
        if isinstance(each, Refused):
            kinds[job.object] = each.kind
        else:
            assert (each.object, each.step, each.worker, each.seconds) == (job.object, 5, "w", 0.25)
            assert (each.method, each.pattern.id) == (job.method, MADE[KINDS[job.object]].pattern.id)
            np.testing.assert_array_equal(each.values, stage.values[job.object])
    return kinds


def decoded(stage: SimpleNamespace) -> list[Factor | Refused]:
    """The factor of each answer, or why it is refused."""
    good, refused = module.decode_several(stage.decoder, stage.message, stage.batch.jobs, range(len(KINDS)))
    found = dict(refused)
    for places, factors in good:
        assert len(places) == len(factors) and not found.keys() & set(places)
        found |= dict(zip(places, factors, strict=True))
    return [found[k] for k in range(len(KINDS))]


def test_they_are_copied_one_behind_the_other_into_memory_of_few_sizes(stage, monkeypatch):
    """From there a GPU copies them by itself."""
    monkeypatch.setattr(module, "LARGE", 0)
    asked = []

    def memory(count: int, dtype: Any) -> np.ndarray:
        asked.append(count)
        return np.full(count, np.nan, dtype)

    stage.decoder.memory = memory
    assert refused(stage) == {}
    total = sum(len(each) for each in stage.values.values())
    assert len(asked) == 1 and asked[0] & (asked[0] - 1) == 0 and total <= asked[0] < 2 * total
    found = [each.values for each in decoded(stage)]
    ends = [each.ctypes.data + each.nbytes for each in found]
    assert [each.ctypes.data for each in found[1:]] == ends[:-1]
    stage.slot.bytes[:] = 0xFF
    assert all(np.isfinite(each).all() for each in found), "nobody can write to them any more"


@pytest.mark.parametrize(
    ("field", "value", "kind"),
    [("seconds", float("nan"), "malformed"), ("seconds", -1.0, "malformed"), ("patterns", 9, "pattern"),
     ("patterns", MADE[1].pattern.id, "pattern"), ("nonzeros", 5, "shape"), ("checksums", 1, "checksum")],
)  # fmt: skip
@pytest.mark.parametrize("place", [0, 1, 4])
def test_what_is_told_wrong_of_one_costs_the_others_nothing(stage, field, value, kind, place):
    getattr(stage.message, field)[place] = value
    name = list(KINDS)[place]
    assert refused(stage) == {name: kind}


@pytest.mark.parametrize(("number", "kind"), [(np.nan, "not_finite"), (np.inf, "not_finite"), (-1.0, "not_positive")])
@pytest.mark.parametrize("place", [0, 2, 4])
def test_a_value_that_no_factor_has_costs_the_others_nothing(stage, number, kind, place):
    name = list(KINDS)[place]
    made = MADE[KINDS[name]].pattern
    values = stage.slot.part(place * ROOM, np.float32, made.nonzeros)
    values[made.diagonal[-1]] = number
    stage.message.checksums[place] = checksum(values)
    assert refused(stage) == {name: kind}


def test_one_that_has_no_room_of_its_own_is_refused_alone(stage):
    stage.batch.rooms[1] = 64
    assert refused(stage) == {"b": "slot"}


@pytest.mark.parametrize("slot", ["none", "another"])
def test_those_of_a_slot_that_was_not_lent_are_refused(stage, slot):
    if slot == "none":
        stage.batch.factor_slot = None
    else:
        stage.batch.factor_generation = 4
    assert refused(stage) == dict.fromkeys(KINDS, "slot")


def test_answers_may_come_in_any_order_and_some_of_them_alone(stage):
    jobs = [stage.batch.jobs[k] for k in (3, 1, 4)]
    good, refused = module.decode_several(stage.decoder, stage.message, jobs, [3, 1, 4])
    assert refused == [] and [factors.objects for _, factors in good] == [["d", "b", "e"]]
    assert [places for places, _ in good] == [[0, 1, 2]]
    for factors in good[0][1]:
        np.testing.assert_array_equal(factors.values, stage.values[factors.object])


def test_of_an_object_that_was_split_meanwhile_nothing_is_taken(stage):
    (row_start, columns), header = GRAPHS[0], Header(protocol=PROTOCOL, incarnation=7, object="b", epoch=2)
    stage.decoder.announce(
        Topology(header=header, nodes=len(row_start) - 1, row_start=row_start.tobytes(), columns=columns.tobytes())
    )
    assert refused(stage) == {"b": "epoch"}


def test_where_all_are_refused_nothing_is_copied(stage):
    stage.message.slot.generation = 8
    assert refused(stage) == dict.fromkeys(KINDS, "slot")
