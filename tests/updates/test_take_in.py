# SPDX-License-Identifier: MIT
"""Factors of a message: copied out of shared memory and looked at by one call of native code."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from protocol.factor import Factor, FactorPattern
from protocol.shared_memory.copies import Parts
from protocol.shared_memory.located import addresses
from protocol.validate import checksum
from sim_server.backends.gpu.inverse.digits import largest_responses, response_function
from sim_server.updates import checked_body, take_in
from sim_server.updates.factor_check import FactorCheck
from tests.worker.block_matrices import bar_edges, pattern, spd

GRAPHS = [pattern(12, bar_edges(1, 1, 2)), pattern(8, bar_edges(1, 1, 1))]
MADE = [Analysis(*graph) for graph in GRAPHS]
KINDS = [0] * 9 + [1] + [0] * 2 + [1] * 5  # of the objects: some are judged together, some alone
GAP = 24  # bytes between factors


def patterns() -> list[FactorPattern]:
    return [MADE[kind].pattern for kind in KINDS]


def names() -> list[str]:
    return [f"{place}" for place in range(len(KINDS))]


@pytest.fixture(params=[np.float32, np.float64], ids=["float32", "float64"])
def stage(request: Any) -> SimpleNamespace:
    """Factors and their matrices; the slot that they lie in, with the first byte of each; memory for them."""
    matrices = [spd(*GRAPHS[kind], seed=place) for place, kind in enumerate(KINDS)]
    values = [MADE[kind].factorize(own, request.param) for kind, own in zip(KINDS, matrices, strict=True)]
    room = np.array([own.nbytes + GAP for own in values])
    made = SimpleNamespace(
        matrices=matrices, values=values, begin=np.cumsum(room) - room + 8, slot=np.full(room.sum(), 0xFF, np.uint8),
        memory=np.full(sum(map(len, values)), np.nan, request.param),
    )  # fmt: skip
    for first, own in zip(made.begin.tolist(), values, strict=True):
        made.slot[first : first + own.nbytes] = own.view(np.uint8)
    return made


def taken(stage: SimpleNamespace, check: Any = None) -> Any:
    source = Parts(stage.slot, stage.begin)
    return take_in.take_in(source, patterns(), stage.memory, check, addresses(stage.matrices))


def value(stage: SimpleNamespace, place: int, entry: int) -> np.ndarray:
    """One value of a factor in the slot."""
    own = stage.values[place]
    return stage.slot[stage.begin[place] :][: own.nbytes].view(own.dtype)[entry : entry + 1]


def test_they_are_copied_one_behind_the_other(stage, monkeypatch):
    for where in (take_in.hash_address, lambda: None):  # of packages without an address for others, too
        monkeypatch.setattr(take_in, "hash_address", where)
        stage.memory[:] = np.nan
        values, found = taken(stage)
        assert stage.memory.tobytes() == b"".join(own.tobytes() for own in stage.values)
        assert [own.ctypes.data for own in values] == [own.address for own in values]
        assert all((a == b).all() for a, b in zip(values, stage.values, strict=True))
        assert found["checksum"].tolist() == [checksum(own) for own in stage.values]
        assert found["finite"].all() and found["positive"].all()


@pytest.mark.parametrize("bad", [np.nan, -np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_found_in_their_factor_alone(stage, bad):
    last = MADE[KINDS[5]].pattern.nonzeros - 1
    value(stage, 2, 17)[:] = value(stage, 5, last)[:] = value(stage, 9, 0)[:] = bad
    value(stage, 4, 1)[:], value(stage, 4, 2)[:] = np.finfo(stage.memory.dtype).max, np.finfo(stage.memory.dtype).tiny
    found = taken(stage).found
    assert np.flatnonzero(found["finite"] == 0).tolist() == [2, 5, 9]
    assert found["checksum"].tolist() == [checksum(own) for own in taken(stage).values]


@pytest.mark.parametrize("bad", [0.0, -0.0, -1.0, np.nan])
@pytest.mark.parametrize("entry", [0, 1, -1])
def test_only_what_stands_on_the_diagonal_must_be_positive(stage, bad, entry):
    for place in (3, 9):
        diagonal = MADE[KINDS[place]].pattern.diagonal
        value(stage, place, int(diagonal[entry]))[:] = bad
    below = int(np.setdiff1d(np.arange(MADE[0].pattern.nonzeros), MADE[0].pattern.diagonal)[entry])
    value(stage, 6, below)[:] = bad
    found = taken(stage).found
    assert np.flatnonzero(found["positive"] == 0).tolist() == [3, 9]


@pytest.mark.parametrize("helping", [0, 3])
def test_what_is_found_is_the_same_as_if_each_came_alone(stage, helping, monkeypatch):
    """To the bit, whatever the number of threads that share them."""
    monkeypatch.setattr(checked_body, "helping_threads", lambda: helping)
    monkeypatch.setattr(take_in, "SHARED", 0)
    check = FactorCheck({name: GRAPHS[kind] for name, kind in zip(names(), KINDS, strict=True)})
    bodies = check.bodies(names(), [1] * len(KINDS), patterns())
    found = taken(stage, take_in.BegunCheck(bodies, response_function(), lambda *_: None)).found
    factors = [
        Factor(name, 1, 5, True, own, values, "w", 0.1)
        for name, own, values in zip(names(), patterns(), stage.values, strict=True)
    ]
    alone = [check.probe(*each) for each in zip(factors, stage.matrices, strict=True)]
    np.testing.assert_array_equal(found["judged"][:, [0, 4]], [[probe.zr, probe.residual] for probe in alone])
    energy = [[probe.reduction, probe.block_jacobi] for probe in alone]
    np.testing.assert_array_equal(found["judged"][:, [0, 2]] ** 2 / found["judged"][:, [1, 3]], energy)
    assert (found["judged"][:, 4] < 1e-3).all(), "each with its own matrix"
    single = stage.memory.dtype == np.float32
    expected = [largest_responses(MADE[kind].pattern, [own])[0] for kind, own in zip(KINDS, stage.values, strict=True)]
    np.testing.assert_array_equal(found["response"], expected if single else np.zeros(len(KINDS)))


def test_memory_of_another_size_and_parts_outside_of_their_array_are_mistakes_of_the_caller(stage):
    for memory in (stage.memory[1:], np.zeros(len(stage.memory), np.float16), np.zeros(2 * len(stage.memory))[::2]):
        with pytest.raises(ValueError, match="numbers of"):
            take_in.take_in(Parts(stage.slot, stage.begin), patterns(), memory)
    for begin in (-1, stage.slot.nbytes - 8, 1 << 62):
        stage.begin[3] = begin
        with pytest.raises(ValueError, match="outside"):
            taken(stage)
