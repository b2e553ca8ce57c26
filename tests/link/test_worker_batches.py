# SPDX-License-Identifier: MIT
"""Jobs of one message at a worker: matrices and factors in slots of shared memory, real factors, on both devices."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from precond_worker.factorization.registry import make_factorization
from precond_worker.network.presence import ServersThere
from precond_worker.worker import Worker
from protocol.channels import PROTOCOL, key
from protocol.messages_pb2 import FactorBatch, Header, MatrixBatch, Topology
from protocol.validate import checksum, topology_checksum
from tests.link.test_worker_loop import FakeConnection, Payload
from tests.support.lent_slot import LentSlot
from tests.support.worker_gpu import WorkerGpu, installed
from tests.worker.block_matrices import GRAPHS, spd
from tests.worker.test_many import reference

GRAPH = GRAPHS["chain"]
NAMES = [f"body{k}" for k in range(7)]
MATRICES = [spd(*GRAPH, seed=seed) for seed in range(len(NAMES))]
SIZE = MATRICES[0].nbytes


class Connection(FakeConnection):
    def __init__(self) -> None:
        super().__init__()
        self.batches: list[FactorBatch] = []

    def topology(self, object: str, epoch: int | None = None) -> Topology:
        self.asked.append((object, epoch))
        header = self.header(object, epoch or 1, "")
        start, columns = (each.tobytes() for each in GRAPH)
        return Topology(header=header, nodes=len(GRAPH[0]) - 1, row_start=start, columns=columns)

    def send_factors(self, message: FactorBatch) -> None:
        self.batches.append(FactorBatch.FromString(message.SerializeToString()))


class Shared(Payload):
    def as_shm(self) -> object:  # type: ignore[override]
        return self


class Stage:
    """A worker, slots, and messages for it. expected: bytes of L of each matrix alone"""

    def __init__(self, library: str, closing: ExitStack):
        self.connection = Connection()
        self.worker = Worker(self.connection, partial(make_factorization, library=library))  # type: ignore[arg-type]
        made: Any = make_factorization(*GRAPH, library=library)
        self.pattern = made.pattern
        self.expected = [made.factorize(matrix, np.float32).tobytes() for matrix in MATRICES]
        self.room = -(-4 * self.pattern.nonzeros // 64) * 64
        self.matrices = closing.enter_context(LentSlot(SIZE * len(NAMES)))
        self.factors = closing.enter_context(LentSlot(self.room * len(NAMES)))
        self.matrices.data[:] = np.concatenate(MATRICES).reshape(-1).view(np.uint8)
        self.connection.received.put(ServersThere((7,)))
        self.step()

    def message(self, first: int = 1, **changes: Any) -> MatrixBatch:
        count = len(NAMES)
        message = MatrixBatch(
            header=Header(protocol=PROTOCOL, incarnation=7, sequence=first), worker="w", factor_dtype="float32",
            method="cholesky", matrix_slot=self.matrices.message, factor_slot=self.factors.message, objects=NAMES,
            epochs=[1] * count, jobs=range(first, first + count), steps=[5] * count, warps=[True] * count,
            blocks=[len(GRAPH[1])] * count, checksums=map(checksum, MATRICES), rooms=[self.room] * count,
            leases=[1.0] * count, known=[1] * count, known_patterns=[self.pattern.id] * count,
            topologies=[topology_checksum(self.connection.topology("any"))] * count,
        )  # fmt: skip
        for name, value in changes.items():
            getattr(message, name)[3] = value
        return message

    def send(self, message: MatrixBatch, payload: Payload | None = None) -> None:
        sample = SimpleNamespace(
            attachment=message.SerializeToString(), payload=Shared() if payload is None else payload,
            key_expr=key("matrices", worker="w"),
        )  # fmt: skip
        self.connection.received.put(sample)
        self.step()

    def step(self) -> None:
        self.worker.take_in(0.0)
        while self.worker.waiting:
            self.worker.work()

    def failures(self) -> dict[int, str]:
        """Of the answers in messages, by place; every other answer must have its factor in its room."""
        found = {}
        for answer in self.connection.batches:
            failures = answer.failures or [""] * len(answer.jobs)
            for job, check, failure in zip(answer.jobs, answer.checksums, failures, strict=True):
                place = (job - 1) % len(NAMES)
                found[place] = failure
                if not failure:
                    at = self.room * place
                    made = self.factors.data[at : at + 4 * self.pattern.nonzeros].tobytes()
                    assert made == self.expected[place] and checksum(made) == check
        return found


@pytest.fixture(params=["supernodal", "gpu"])
def stage(request: pytest.FixtureRequest) -> Iterator[Stage]:
    with ExitStack() as closing:
        closing.enter_context(installed(WorkerGpu(reference)))
        yield Stage(request.param, closing)


def test_all_are_answered_with_the_factors_of_each_alone(stage: Stage) -> None:
    for first in (1, 8, 15):
        stage.factors.data[:] = 0
        stage.send(stage.message(first))
        assert stage.failures() == dict.fromkeys(range(len(NAMES)), "")
        answer = stage.connection.batches[-1]
        assert sum(len(each.jobs) for each in stage.connection.batches) == len(NAMES)
        assert answer.matrix_shared and set(answer.patterns) == {stage.pattern.id} and not answer.remedies
        stage.connection.batches.clear()
    assert stage.connection.answers == [] and len(stage.connection.asked) == 5, "one topology is asked for once"
    counters = stage.connection.counters
    assert (counters.jobs, counters.factors, counters.bulk_shared) == (3 * len(NAMES),) * 3 and not counters.refused


@pytest.mark.parametrize(
    ("changes", "said"),
    [({"checksums": 1}, "checksum does not match"), ({"blocks": 2}, "blocks is 2; allowed: 208")],
    ids=["checksum", "blocks"],
)
def test_what_is_wrong_with_one_is_told_and_costs_the_others_nothing(
    stage: Stage, changes: dict[str, int], said: str
) -> None:
    stage.send(stage.message())
    stage.connection.batches.clear()
    message = stage.message(8, **changes)
    if "blocks" in changes:  # what comes behind it moves up
        moved = np.concatenate([each if k != 3 else each[:2] for k, each in enumerate(MATRICES)])
        stage.matrices.data[: moved.nbytes] = moved.reshape(-1).view(np.uint8)
    stage.send(message)
    failures = stage.failures()
    assert failures.keys() == set(range(len(NAMES))), "every other one is answered"
    assert [place for place, failure in failures.items() if failure] == [3] and said in failures[3]


def test_one_without_a_factor_gets_its_remedy_and_the_others_have_none(stage: Stage) -> None:
    stage.send(stage.message())
    stage.connection.batches.clear()
    spoilt = -MATRICES[3]
    stage.matrices.data[3 * SIZE : 4 * SIZE] = spoilt.reshape(-1).view(np.uint8)
    alone: Any = make_factorization(*GRAPH, library="supernodal")
    remedies: dict[int, str] = {}
    try:
        stage.expected[3] = alone.factorize(spoilt, np.float32).tobytes()
    except ValueError:
        pytest.fail("the CPU has a remedy")
    stage.send(stage.message(8, checksums=checksum(spoilt)))
    for answer in stage.connection.batches:
        for job, remedy in zip(answer.jobs, answer.remedies or [""] * len(answer.jobs), strict=True):
            remedies[(job - 1) % len(NAMES)] = remedy
    told = {place: bool(remedy) for place, remedy in remedies.items() if place != 3}
    assert told == dict.fromkeys((0, 1, 2, 4, 5, 6), False)
    if stage.connection.library == "supernodal":
        assert stage.failures() == dict.fromkeys(range(7), "") and "LDL^T" in remedies[3]
    else:  # the fronts of a GPU have no D
        assert "not positive definite" in stage.failures()[3]


def test_a_factor_that_has_no_room_travels_alone(stage: Stage) -> None:
    stage.send(stage.message())
    stage.connection.batches.clear()
    for message in (stage.message(8, rooms=0), stage.message(15, rooms=64)):
        stage.connection.answers.clear()
        message.rooms[4] = 2 * stage.room - message.rooms[3]  # so that those behind it lie where they did
        stage.send(message)
        ((answer, data),) = stage.connection.answers
        assert answer.header.object == NAMES[3] and data == stage.expected[3]


def test_an_answer_to_a_slot_that_was_lent_again_is_not_written(stage: Stage) -> None:
    stage.send(stage.message())
    stage.factors.data[:] = 7
    stage.connection.batches.clear()
    stage.factors.lend(2)
    stage.send(stage.message(8))
    assert (stage.factors.data == 7).all() and stage.connection.counters.refusals["late"] > 0
    for answer in stage.connection.batches:
        assert len(answer.failures) == len(answer.jobs) and all(answer.failures)


def test_matrices_that_come_as_bytes_are_taken_too(stage: Stage) -> None:
    """As by a reader without shared memory, which gets the whole slot."""
    stage.send(stage.message())
    stage.connection.batches.clear()
    stage.send(stage.message(8), Payload(bytes(64) + stage.matrices.data.tobytes()))
    assert stage.failures() == dict.fromkeys(range(len(NAMES)), "")
    assert stage.connection.counters.bulk_copied == len(NAMES)
    stage.connection.batches.clear()
    stage.send(stage.message(15), Payload(bytes(64) + stage.matrices.data[:-8].tobytes()))
    assert all("bytes; allowed" in failure for failure in stage.failures().values())


def test_jobs_of_two_messages_and_one_that_came_alone_are_factorized_together(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    from precond_worker.factorization.modified_cholesky import ModifiedCholesky
    from protocol.messages_pb2 import Matrix
    from tests.link.test_worker_loop import Sample

    stage.send(stage.message())
    stage.connection.batches.clear()
    sizes, begin = [], ModifiedCholesky.begin_many
    monkeypatch.setattr(
        ModifiedCholesky, "begin_many", lambda self, given, dtype: sizes.append(len(given)) or begin(self, given, dtype)
    )
    second = stage.message(8)
    second.objects[:] = [f"other{name}" for name in NAMES]
    header = Header(protocol=PROTOCOL, incarnation=7, object="alone", epoch=1, sequence=99)
    single = Matrix(
        header=header, step=5, blocks=len(GRAPH[1]), checksum=checksum(MATRICES[2]), factor_dtype="float32",
        method="cholesky", worker="w", topology=second.topologies[0],
    )  # fmt: skip
    stage.connection.received.put(Sample(single, MATRICES[2]))
    for message in (second, stage.message(15)):
        stage.connection.received.put(
            SimpleNamespace(
                attachment=message.SerializeToString(), payload=Shared(), key_expr=key("matrices", worker="w")
            )
        )
    stage.step()
    assert sizes == [15] and stage.failures() == dict.fromkeys(range(len(NAMES)), "")
    ((answer, data),) = stage.connection.answers
    assert answer.header.object == "alone" and data == stage.expected[2]


def test_the_server_is_told_of_all_objects_not_of_the_last_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three of one kind, of which 60 are made together, and one of which 4 are: 4 / (3 / 60 + 1 / 4), in any order."""
    from precond_worker.jobs.analyses import Analyses

    class Made:
        library = "made"

        def __init__(self, start: np.ndarray, columns: np.ndarray, method: Any):
            self.together = 4 if len(start) == 3 else 60

    connection = FakeConnection()
    connection.objects = dict.fromkeys("abc", 5) | {"d": 2}
    analyses = Analyses(connection, Made)  # type: ignore[arg-type]
    job: Callable[[str], Any] = lambda name: SimpleNamespace(  # noqa: E731
        object=name, epoch=1, topology=0, blocks=connection.objects[name], method=SimpleNamespace(name="cholesky")
    )
    assert analyses.together == 1
    jobs = {name: job(name) for name in "abcd"}
    told = []
    for name in "abcdadbd":
        analyses.of_job(jobs[name])
        told.append(analyses.together)
    assert told == [60, 60, 60, 13, 13, 13, 13, 13]
    analyses.clear()
    assert analyses.together == 1 and not analyses
