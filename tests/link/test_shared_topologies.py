# SPDX-License-Identifier: MIT
"""What the server knows of objects whose matrices have one pattern, once one of them has had a factor."""

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from protocol.channels import PROTOCOL, key
from protocol.messages_pb2 import Factor as FactorMessage
from protocol.messages_pb2 import Header, Topology
from protocol.refused import Refused
from protocol.validate import checksum
from sim_server.network.factor_decoder import FactorDecoder
from tests.support.in_flight import in_flight
from tests.worker.block_matrices import bar_edges, pattern, spd

GRAPH = pattern(12, bar_edges(2, 1, 1), np.arange(4))
OTHER = pattern(12, bar_edges(2, 1, 1), np.arange(3))
ANALYSIS = Analysis(*GRAPH)


def topology(name: str, graph: tuple[np.ndarray, np.ndarray] = GRAPH, epoch: int = 1) -> Topology:
    header = Header(protocol=PROTOCOL, incarnation=7, object=name, epoch=epoch)
    row_start, columns = (np.asarray(each, np.int32).tobytes() for each in graph)
    return Topology(header=header, nodes=12, row_start=row_start, columns=columns)


@pytest.fixture
def decoder() -> FactorDecoder:
    decoder = FactorDecoder(7)
    for name in "ab":
        decoder.announce(topology(name))
    decoder.announce(topology("other", OTHER))
    return decoder


def send_pattern(decoder: FactorDecoder, name: str) -> None:
    header = Header(protocol=PROTOCOL, incarnation=7, object=name, epoch=1)
    message = ANALYSIS.pattern.message(header).SerializeToString()
    decoder.add_pattern(key("pattern", worker="w", object=name), message)


def answer(decoder: FactorDecoder, name: str, method: str = "cholesky", epoch: int = 1) -> None:
    """Decodes a factor of an object."""
    values = ANALYSIS.factorize(spd(*GRAPH), np.float32)
    header = Header(protocol=PROTOCOL, incarnation=7, object=name, epoch=epoch)
    message = FactorMessage(
        header=header, step=3, warp=True, dtype="float32", pattern=ANALYSIS.pattern.id, nonzeros=len(values),
        checksum=checksum(values),
    )  # fmt: skip
    job = in_flight(1, name, epoch, 3, "float32", "w", 9.0, method=method)
    assert np.array_equal(decoder.decode(message, values.tobytes(), job).values, values)


def test_one_factor_tells_of_all_objects_of_its_topology(decoder: FactorDecoder) -> None:
    known, id = decoder.objects, ANALYSIS.pattern.id
    assert known["a"].topology == known["b"].topology != known["other"].topology
    send_pattern(decoder, "a")
    assert known["b"].pattern(id) is None and not decoder.most_are_sized, "a pattern alone may be of any method"
    answer(decoder, "a")
    assert known["b"].pattern(id) is known["a"].pattern(id) is not None
    assert known["b"].known_patterns == known["a"].known_patterns == [id]
    assert known["b"].most_values("cholesky") == ANALYSIS.pattern.nonzeros and known["b"].most_values("ssor") == 0
    assert known["other"].pattern(id) is None and known["other"].most_values("cholesky") == 0
    answer(decoder, "b")
    with pytest.raises(Refused, match="which was not sent"):
        answer(decoder, "other")
    decoder.announce(topology("c"))
    assert known["c"].most_values("cholesky") == ANALYSIS.pattern.nonzeros, "also one that comes later"


def test_incomplete_factors_tell_of_their_own_object_alone(decoder: FactorDecoder) -> None:
    """Each has a pattern of its own, and another one whenever blocks are dropped otherwise."""
    send_pattern(decoder, "a")
    answer(decoder, "a", "incomplete_cholesky")
    assert decoder.objects["a"].most_values("incomplete_cholesky") == ANALYSIS.pattern.nonzeros
    assert decoder.objects["b"].known_patterns == [] and decoder.objects["b"].most_values("incomplete_cholesky") == 0


def test_sizes_are_known_once_each_topology_has_had_a_factor(decoder: FactorDecoder) -> None:
    decoder.announce(topology("other", GRAPH, epoch=2))  # its mesh has changed, and is like the others now
    send_pattern(decoder, "a")
    assert not decoder.most_are_sized
    answer(decoder, "a")
    assert decoder.most_are_sized
    decoder.announce(topology("b", OTHER, epoch=2))
    assert decoder.objects["b"].pattern(ANALYSIS.pattern.id) is None and not decoder.most_are_sized


def test_a_factor_of_an_epoch_that_ends_while_it_is_taken_in_tells_nothing_of_the_next(decoder: FactorDecoder) -> None:
    """Large ones are taken in by another thread, while the mesh of their object may be split."""
    send_pattern(decoder, "a")
    values = ANALYSIS.factorize(spd(*GRAPH), np.float32)
    header = Header(protocol=PROTOCOL, incarnation=7, object="a", epoch=1)
    message = FactorMessage(
        header=header, step=3, warp=True, dtype="float32", pattern=ANALYSIS.pattern.id, nonzeros=len(values)
    )
    job = in_flight(1, "a", 1, 3, "float32", "w", 9.0)

    def arriving() -> np.ndarray:
        decoder.announce(topology("a", OTHER, epoch=2))
        return values

    decoder.decode(message, b"", job, arriving)
    known = decoder.objects["a"]
    assert known.epoch == 2 and known.known_patterns == [] and known.most_values("cholesky") == 0
    assert decoder.objects["other"].known_patterns == [], "nor of another of the new topology"
    send_pattern(decoder, "b")
    with pytest.raises(Refused, match="of an epoch of a that is over"):
        decoder.decode(message, b"", job, lambda: values)
