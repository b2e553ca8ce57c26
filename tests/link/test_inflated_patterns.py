# SPDX-License-Identifier: MIT
"""What a worker says of its factors sets the slots of all who work for an object: it must be what one may need."""

from typing import Any

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from protocol.channels import PROTOCOL, key
from protocol.factor import FactorPattern
from protocol.messages_pb2 import Factor, Header, Topology
from protocol.refused import Refused
from protocol.validate import checksum
from sim_server.network import factor_decoder as module
from sim_server.network.factor_decoder import FactorDecoder
from sim_server.scene.size_limits import expected_values
from tests.scenes import simulation
from tests.support.in_flight import in_flight

CELLS = {"long": (1, 1, 60), "small": (4, 4, 4), "flat": (20, 20, 1), "cube": (10, 10, 10)}


def graph(cells: tuple[int, int, int], elements: str = "linear") -> tuple[Any, Any]:
    """row_start and columns of A of a bar."""
    effects = {"corotational": {"young": 1e5, "poisson": 0.3}}
    mesh = {"bar": list(cells), "size": [1, 1, 1]}
    sim = simulation({"name": "body", "mesh": mesh, "elements": elements, "effects": effects})
    return sim.system.row_start, sim.system.columns


@pytest.mark.parametrize("elements", ["linear", "patch", "smoothed", "quadratic"])
@pytest.mark.parametrize("cells", CELLS.values(), ids=CELLS)
def test_what_is_expected_is_near_what_factors_have(cells: tuple[int, int, int], elements: str) -> None:
    """Never less, and not more than six times as much where bodies are no thin rods."""
    if elements == "quadratic" and np.prod(cells) > 500:
        cells = (5, 5, 6)
    row_start, columns = graph(cells, elements)
    found = Analysis(row_start, columns).pattern.nonzeros
    expected = expected_values(len(row_start) - 1, len(columns))
    assert found <= expected <= 6 * found


@pytest.fixture
def stage() -> tuple[FactorDecoder, Header, tuple[Any, Any]]:
    """A decoder that knows of a body of a thousand nodes."""
    row_start, columns = graph((8, 9, 10))
    decoder, header = FactorDecoder(7), Header(protocol=PROTOCOL, incarnation=7, object="body", epoch=1)
    decoder.announce(
        Topology(header=header, nodes=len(row_start) - 1, row_start=row_start.tobytes(), columns=columns.tobytes())
    )
    return decoder, header, (row_start, columns)


def send(decoder: FactorDecoder, header: Header, pattern: FactorPattern) -> None:
    decoder.add_pattern(key("pattern", worker="w", object="body"), pattern.message(header).SerializeToString())


def dense(n: int) -> FactorPattern:
    """One supernode: a few kilobytes say that a factor is full."""
    return FactorPattern.build(np.arange(n), [0, n], [0, n], np.arange(n))


def test_a_pattern_far_larger_than_factors_are_is_refused_and_sets_no_slot(stage) -> None:
    decoder, header, given = stage
    honest, body = Analysis(*given).pattern, decoder.objects["body"]
    send(decoder, header, honest)
    assert body.most_values("cholesky") == honest.nonzeros
    with pytest.raises(Refused, match=r"FactorPattern.nonzeros is \d+; allowed for the \d+ blocks") as refused:
        send(decoder, header, dense(body.size))
    assert refused.value.kind == "size"
    assert body.most_values("cholesky") == honest.nonzeros and len(body.patterns) == 1


def test_one_of_a_poor_ordering_passes(stage) -> None:
    """Twice the values: what a worker with another library may need."""
    decoder, _, given = stage
    honest = Analysis(*given).pattern
    assert 2 * honest.nonzeros < decoder.objects["body"].most_allowed < 20 * honest.nonzeros


def test_a_small_body_may_have_a_dense_factor(stage) -> None:
    decoder, header, _ = stage
    row_start, columns = graph((1, 1, 50))
    header.epoch = 2
    decoder.announce(
        Topology(header=header, nodes=len(row_start) - 1, row_start=row_start.tobytes(), columns=columns.tobytes())
    )
    full = dense(3 * (len(row_start) - 1))
    assert full.nonzeros < module.ALWAYS_ALLOWED
    send(decoder, header, full)
    assert decoder.objects["body"].most_values("cholesky") == full.nonzeros


def test_one_whose_factor_is_rejected_sets_no_slot_from_then_on(stage) -> None:
    """Of others neither, which share its topology."""
    decoder, header, _ = stage
    row_start, columns = graph((3, 3, 20))
    names, size = ("body", "other"), 3 * (len(row_start) - 1)
    for name in names:
        told = Header(protocol=PROTOCOL, incarnation=7, object=name, epoch=2)
        decoder.announce(
            Topology(header=told, nodes=size // 3, row_start=row_start.tobytes(), columns=columns.tobytes())
        )
    header.epoch = 2
    honest, full = Analysis(row_start, columns).pattern, dense(size)

    def answer(pattern: FactorPattern) -> None:
        send(decoder, header, pattern)
        values = np.ones(pattern.nonzeros, np.float32)
        message = Factor(
            header=header, step=5, warp=True, dtype="float32", pattern=pattern.id, nonzeros=pattern.nonzeros,
            worker="w", job=1, checksum=checksum(values),
        )  # fmt: skip
        decoder.decode(message, values.tobytes(), in_flight(1, "body", 2, 5, "float32", "w", 9.0))

    def most() -> list[int]:
        return [decoder.objects[name].most_values("cholesky") for name in names]

    answer(honest)
    assert most() == [honest.nonzeros] * 2
    answer(full)
    assert most() == [full.nonzeros] * 2 and full.nonzeros > 2 * honest.nonzeros
    decoder.on_rejected("body", full.id)
    assert most() == [honest.nonzeros] * 2
    decoder.on_rejected("body", honest.id)  # an honest one that is of no use
    assert most()[1] == honest.nonzeros
    answer(honest)
    assert most() == [honest.nonzeros] * 2
