# SPDX-License-Identifier: MIT
"""The worker's loop without a network: what it keeps, drops and answers."""

import json
import logging
import re
import sys
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from precond_worker.errors import DeviceUnusable
from precond_worker.jobs import preparation
from precond_worker.many import Begun, Made, Matrices
from precond_worker.network.presence import ServerGone, ServersThere
from precond_worker.network.receive_queue import ReceiveQueue
from precond_worker.worker import Worker
from protocol.channels import PROTOCOL, key
from protocol.counters import Counters
from protocol.factor import FactorPattern
from protocol.messages_pb2 import DeviceSlot, Factor, Header, Matrix, Scene, Topology
from protocol.method import Method
from protocol.network.factor_parts import bytes_of, part_checksums
from protocol.refused import Refused
from protocol.shared_memory.view import SlotMap
from protocol.validate import check_header, checksum, topology_checksum


class Payload(bytes):
    def as_shm(self) -> None:
        return None


class Sample:
    def __init__(self, message: Matrix, values: np.ndarray):
        self.attachment = message.SerializeToString()
        self.payload = Payload(values.tobytes())
        self.key_expr = key("matrix", worker="w", object=message.header.object)


class Diagonal:
    """Factorizes diagonal matrices: L is the root of the diagonal."""

    library, remedy = "diagonal", ""

    def __init__(self, row_start: np.ndarray, columns: np.ndarray, method: Method):
        self.method = method
        self.size = 3 * (len(row_start) - 1)
        counts = np.arange(self.size + 1)
        self.pattern = FactorPattern.build(np.arange(self.size), counts, counts, np.arange(self.size))

    def factorize(self, values: np.ndarray, dtype: Any) -> np.ndarray:
        diagonal = np.einsum("bii->bi", values).reshape(-1)
        if (diagonal <= 0).any():
            raise ValueError("not positive definite")
        return np.sqrt(diagonal).astype(dtype)


class FakeOffers:
    """Factors that are kept to be asked for."""

    def __init__(self) -> None:
        self.kept: dict[str, tuple[int, np.ndarray]] = {}

    def offer(self, object: str, header: Header, job: int, values: np.ndarray, part_bytes: int) -> list[int]:
        self.kept[object] = job, values
        return part_checksums(bytes_of(values), part_bytes)

    def withdraw(self, objects: list[str]) -> None:
        for object in objects:
            self.kept.pop(object, None)

    def clear(self) -> None:
        self.kept.clear()


class FakeConnection:
    """The network as the worker sees it; answers and patterns pile up here."""

    def __init__(self) -> None:
        self.name, self.server, self.incarnation, self.library = "w", "sim", 0, ""
        self.counters = Counters(logging.getLogger("test"))
        self.received: ReceiveQueue[Any] = ReceiveQueue(8)
        self.slots = SlotMap()
        self.offered = FakeOffers()
        self.answers: list[tuple[Factor, bytes]] = []
        self.patterns: list[tuple[str, int]] = []
        self.asked: list[tuple[str, int | None]] = []
        self.objects: dict[str, int] = {}  # nodes of those that the scene tells of
        self.preconditioner = "cholesky"
        self.told, self.together = 0, 0  # times that it said hello; matrices that it factorizes together
        self.without_token: set[int] = set()
        self.shared_memory = True

    def has_token(self, incarnation: int) -> bool:
        return incarnation not in self.without_token

    def follow(self, incarnation: int) -> None:
        self.incarnation = incarnation

    def header(self, object: str, epoch: int, channel: str) -> Header:
        return Header(protocol=PROTOCOL, incarnation=self.incarnation, object=object, epoch=epoch)

    def topology(self, object: str, epoch: int | None = None) -> Topology:
        self.asked.append((object, epoch))
        if object == "unknown":
            raise Refused("the server has no topology of unknown", "object")
        header, nodes = self.header(object, epoch or 1, ""), self.objects.get(object, 2)
        row_start = np.arange(nodes + 1, dtype=np.int32)
        return Topology(header=header, nodes=nodes, row_start=row_start.tobytes(), columns=row_start[:-1].tobytes())

    def scene(self) -> Scene:
        self.asked.append(("scene", 0))
        if not self.objects:
            return Scene()
        return Scene(objects=self.objects, resolved=json.dumps({"solver": {"preconditioner": self.preconditioner}}))

    def tell(self) -> None:
        self.told += 1

    def send_pattern(self, pattern: FactorPattern, object: str, epoch: int) -> None:
        self.patterns.append((object, epoch))

    def send_factor(self, message: Factor, values: bytes = b"") -> None:
        self.answers.append((message, values))


@pytest.fixture
def connection() -> FakeConnection:
    return FakeConnection()


@pytest.fixture
def worker(connection: FakeConnection) -> Worker:
    worker = Worker(connection, Diagonal)  # type: ignore[arg-type]
    connection.received.put(ServersThere((7,)))
    worker.step(0.0)
    connection.asked.clear()  # for the scene
    return worker


def matrix(number: int = 1, object: str = "beam", epoch: int = 1, scale: float = 4.0, **changes: Any) -> Sample:
    values = scale * np.stack([np.eye(3), np.eye(3)])
    header = Header(protocol=PROTOCOL, incarnation=7, object=object, epoch=epoch, sequence=number)
    fields = {
        "header": header,
        "step": 10 * number,
        "blocks": 2,
        "checksum": checksum(values),
        "factor_dtype": "float32",
        "method": "cholesky",
        "worker": "w",
    }
    return Sample(Matrix(**(fields | changes)), values)


def drain(worker: Worker, connection: FakeConnection, *samples: Sample) -> None:
    for sample in samples:
        connection.received.put(sample)
    for _ in range(len(samples) + 1):
        worker.step(0.0)


def test_a_matrix_is_answered_with_its_factor(worker: Worker, connection: FakeConnection) -> None:
    drain(worker, connection, matrix())
    ((answer, data),) = connection.answers
    check_header(answer, incarnation=7, object="beam", epoch=1)
    assert np.array_equal(np.frombuffer(data, np.float32), np.full(6, 2.0))
    assert (answer.step, answer.job, answer.worker, answer.dtype, answer.failure) == (10, 1, "w", "float32", "")
    assert answer.checksum == checksum(data) and answer.nonzeros == 6
    assert connection.patterns == [("beam", 1)] and connection.library == "diagonal"


def test_the_server_is_not_asked_for_a_topology_that_is_known(worker: Worker, connection: FakeConnection) -> None:
    shape = topology_checksum(connection.topology("a", 1))
    connection.asked.clear()
    told = [matrix(k, name, topology=shape) for k, name in ((1, "a"), (2, "b"))]
    other = matrix(3, "c", topology=shape, method="ssor", omega=1.0)
    drain(worker, connection, *told, other, matrix(4, "d"), matrix(5, "e", topology=shape, blocks=3))
    assert connection.asked == [("a", 1), ("c", 1), ("d", 1)], "another method, or another topology, may be"
    failures = {answer.header.object: answer.failure for answer, _ in connection.answers}
    assert [name for name, failure in failures.items() if failure] == ["e"]
    assert "blocks is 3; allowed: 2" in failures["e"]


LARGE = 2000  # nodes of an object that is worth it


class Ready(Diagonal):
    """One whose first matrix would wait for memory."""

    made: ClassVar[list[int]] = []
    ready: ClassVar[list[int]] = []
    error: ClassVar[Exception | None] = None

    def __init__(self, row_start: np.ndarray, columns: np.ndarray, method: Method):
        super().__init__(row_start, columns, method)
        self.made.append(self.size)

    def make_ready(self) -> None:
        if self.error is not None:
            raise self.error
        self.ready.append(self.size)


@pytest.fixture
def ahead(connection: FakeConnection, monkeypatch: pytest.MonkeyPatch) -> Worker:
    for name in ("made", "ready"):
        monkeypatch.setattr(Ready, name, [])
    connection.objects = {"small": 3, "large": LARGE, "twin": LARGE, "unknown": LARGE}
    connection.received.put(ServersThere((7,)))
    return Worker(connection, Ready)  # type: ignore[arg-type]


def test_large_objects_are_made_ready_for_before_their_first_matrix(ahead: Worker, connection: FakeConnection) -> None:
    ahead.take_in(0.0)
    assert ahead.waiting == 1 and not ahead.idle, "the server may wait for that"
    while ahead.waiting:
        ahead.step(0.0)
    assert Ready.made == [3 * LARGE] and Ready.ready == [3 * LARGE] * 2, "once for objects of one topology"
    assert connection.patterns == [("large", 1), ("twin", 1)] and connection.answers == []
    assert ahead.idle and connection.told == 1 and connection.counters.jobs == 0
    asked = len(connection.asked)
    drain(ahead, connection, matrix(object="large", blocks=LARGE, omega=1.0))
    assert len(connection.asked) == asked and Ready.made == [3 * LARGE]


def test_a_server_that_does_not_tell_yet_what_it_simulates_is_asked_again(
    ahead: Worker, connection: FakeConnection, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker that was there before its server finds it while the scene is still being made."""
    told, refusals = connection.scene, 3

    def scene() -> Scene:
        nonlocal refusals
        refusals -= 1
        if refusals >= 0:
            raise Refused("the server does not tell what it simulates", "object")
        return told()

    monkeypatch.setattr(connection, "scene", scene)
    monkeypatch.setattr(preparation, "ASK_AGAIN", 1000.0)
    ahead.step(0.0)
    assert ahead.idle and ahead.waiting == 0 and 900 < ahead.pause < 1000, "nobody waits for that"
    monkeypatch.setattr(preparation, "ASK_AGAIN", 0.0)
    ahead.preparation.ask_at = 0.0
    while ahead.waiting:
        ahead.step(0.0)
    assert refusals == -1 and Ready.made == [3 * LARGE] and ahead.pause == float("inf")


def test_a_server_that_tells_nothing_is_not_asked_after_its_first_job(
    ahead: Worker, connection: FakeConnection, monkeypatch: pytest.MonkeyPatch
) -> None:
    def scene() -> Scene:
        raise Refused("the server does not tell what it simulates", "object")

    monkeypatch.setattr(connection, "scene", scene)
    monkeypatch.setattr(preparation, "ASK_AGAIN", 0.0)
    for _ in range(5):
        ahead.step(0.0)
    assert ahead.pause == 0.0
    drain(ahead, connection, matrix(object="first"))
    assert len(connection.answers) == 1 and ahead.idle and ahead.pause == float("inf")


def test_a_job_goes_before_what_is_to_be_prepared(ahead: Worker, connection: FakeConnection) -> None:
    connection.received.put(matrix(object="first"))
    ahead.step(0.0)
    assert [answer.header.object for answer, _ in connection.answers] == ["first"] and ahead.waiting == 1
    assert connection.asked == [("first", 1)] and connection.told == 0


@pytest.mark.parametrize(("preconditioner", "count"), [("ssor_factor", 1), ("cholesky", 9)])
def test_nothing_is_prepared_for_other_factors_or_where_objects_are_many(
    ahead: Worker, connection: FakeConnection, preconditioner: str, count: int
) -> None:
    connection.preconditioner, connection.objects = preconditioner, {f"body{k}": LARGE for k in range(count)}
    while not ahead.idle:
        ahead.step(0.0)
    assert connection.asked == [("scene", 0)] and Ready.made == []


def test_a_worker_elsewhere_asks_for_nothing_before_its_first_job(ahead: Worker, connection: FakeConnection) -> None:
    connection.shared_memory = False
    ahead.take_in(0.0)
    assert ahead.idle and ahead.waiting == 0 and connection.asked == []


def test_what_cannot_be_prepared_is_left_for_the_first_job(
    ahead: Worker, connection: FakeConnection, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Ready, "error", MemoryError("full"))
    while not ahead.idle:
        ahead.step(0.0)
    assert Ready.ready == []
    drain(ahead, connection, matrix(object="first"))
    assert [answer.failure for answer, _ in connection.answers] == [""], "it lives on"
    monkeypatch.setattr(Ready, "error", DeviceUnusable("gone"))
    ahead.preparation.unprepared.append("large")
    with pytest.raises(DeviceUnusable):
        ahead.step(0.0)


class Together(Diagonal):
    """Factorizes up to three matrices of one pattern together, on a device unless `beside` is False."""

    most, together, beside = 3, 3, True
    sizes: ClassVar[list[int]] = []
    ended: ClassVar[list[int]] = []

    def begin_many(self, matrices: Matrices, dtype: Any) -> Begun:
        given = np.empty((len(matrices), 9 * matrices.blocks))
        matrices.copy_to(given)
        self.sizes.append(len(given))

        def end() -> Made:
            self.ended.append(len(given))
            values, good = np.zeros((len(given), self.size), dtype), np.ones(len(given), bool)
            for k, each in enumerate(given):
                try:
                    values[k] = self.factorize(each.reshape(-1, 3, 3), dtype)
                except ValueError:
                    good[k] = False
            return Made(values, good)

        return Begun(end, self.beside)


@pytest.fixture
def together(connection: FakeConnection) -> Worker:
    worker = Worker(connection, Together)  # type: ignore[arg-type]
    connection.received.put(ServersThere((7,)))
    worker.step(0.0)
    Together.sizes, Together.ended = [], []
    drain(worker, connection, *(matrix(k + 1, name) for k, name in enumerate("abcd")))  # analyses
    assert Together.sizes == []
    connection.answers.clear()
    return worker


def test_objects_of_one_pattern_are_factorized_together(together: Worker, connection: FakeConnection) -> None:
    for k, name in enumerate("abcd"):
        connection.received.put(matrix(10 + k, name, scale=4.0 + k))
    together.step(0.0)
    together.step(0.0)
    assert Together.sizes == [3]
    for k, (answer, data) in enumerate(connection.answers):
        assert (answer.header.object, answer.job, answer.failure) == ("abcd"[k], 10 + k, "")
        np.testing.assert_array_equal(np.frombuffer(data, np.float32), np.float32(np.sqrt(4.0 + k)))
    assert len(connection.answers) == 4 and connection.counters.jobs == 8 and connection.received.idle
    assert connection.together == Together.most == 3, "as the server is told"


def test_one_without_a_factor_does_not_spoil_those_of_others(together: Worker, connection: FakeConnection) -> None:
    for k, name in enumerate("abc"):
        connection.received.put(matrix(10 + k, name, scale=-4.0 if name == "b" else 4.0))
    together.step(0.0)
    assert not connection.answers and together.waiting == 3, "they are under way"
    together.step(0.0)
    assert together.idle
    failures = {answer.header.object: bool(answer.failure) for answer, _ in connection.answers}
    assert failures == {"a": False, "b": True, "c": False} and Together.sizes == [3]


def test_a_spoiled_matrix_does_not_spoil_those_of_others(together: Worker, connection: FakeConnection) -> None:
    for k, name in enumerate("abc"):
        connection.received.put(matrix(10 + k, name, **({"checksum": 1} if name == "b" else {})))
    together.step(0.0)
    failures = {answer.header.object: answer.failure for answer, _ in connection.answers}
    assert "checksum" in failures["b"] and failures["a"] == failures["c"] == ""


def test_what_is_under_way_is_answered_when_told_to_finish(together: Worker, connection: FakeConnection) -> None:
    for k, name in enumerate("abc"):
        connection.received.put(matrix(10 + k, name))
    together.step(0.0)
    assert together.waiting == 3 and connection.answers == []
    together.finish()
    assert [answer.job for answer, _ in connection.answers] == [10, 11, 12] and together.idle
    together.finish()
    assert len(connection.answers) == 3


def test_what_is_under_way_for_a_server_that_is_gone_is_awaited(together: Worker, connection: FakeConnection) -> None:
    """A device writes to its memory until then. Nobody is answered."""
    for k, name in enumerate("abc"):
        connection.received.put(matrix(10 + k, name))
    together.step(0.0)
    assert together.waiting == 3 and Together.ended == []
    connection.received.put(ServerGone(7))
    together.step(0.0)
    assert Together.ended == [3] and together.idle
    assert connection.answers == [] and connection.counters.superseded == 3


def test_other_types_are_not_factorized_together(together: Worker, connection: FakeConnection) -> None:
    for k, name in enumerate("abc"):
        connection.received.put(matrix(10 + k, name, factor_dtype="float64" if name == "b" else "float32"))
    together.step(0.0)
    together.step(0.0)
    assert Together.sizes == [2] and len(connection.answers) == 3


def test_it_is_idle_when_nothing_came_or_waits_or_is_at_work(connection: FakeConnection) -> None:
    seen: list[bool] = []

    class Watched(Diagonal):
        def factorize(self, values: np.ndarray, dtype: Any) -> np.ndarray:
            seen.append(connection.received.idle)
            return super().factorize(values, dtype)

    worker = Worker(connection, Watched)  # type: ignore[arg-type]
    assert connection.received.idle
    connection.received.put(ServersThere((7,)))
    worker.step(0.0)
    assert connection.received.idle
    connection.received.put(matrix())
    connection.received.put(matrix(2, object="bar"))
    assert not connection.received.idle, "they came"
    worker.take_in(0.0)
    assert not connection.received.idle, "they wait"
    worker.work()
    assert not connection.received.idle and seen == [False], "the other one waits"
    worker.work()
    assert connection.received.idle and seen == [False, False] and len(connection.answers) == 2
    for lost in ((ServerGone(7), matrix(3)), (ServersThere((7,)), matrix(4, worker="x"))):
        for item in lost:
            connection.received.put(item)
        worker.step(0.0)
        assert connection.received.idle and len(connection.answers) == 2, "what it refused it does not have"


class Doubling:
    """Builds 2 (x + y + z) I for each of two nodes."""

    made = 0

    def __init__(self, scene: Scene, topology: Topology):
        Doubling.made += 1

    def matrix(self, x: np.ndarray) -> np.ndarray:
        if x.shape != (2, 3):
            raise ValueError(f"positions {x.shape}")
        return 2 * x.sum(axis=1)[:, None, None] * np.eye(3)


def positions(number: int, x: np.ndarray, **changes: Any) -> Sample:
    message = Matrix.FromString(matrix(number).attachment)
    message.nodes, message.checksum = len(x), checksum(x)
    for name, value in changes.items():
        setattr(message, name, value)
    return Sample(message, x)


@pytest.fixture
def doubling(monkeypatch: pytest.MonkeyPatch) -> None:
    Doubling.made = 0
    monkeypatch.setitem(sys.modules, "sim_server.updates.worker_assembly", SimpleNamespace(Assembly=Doubling))


def test_from_positions_the_worker_builds_the_matrix_itself(
    worker: Worker, connection: FakeConnection, doubling: None
) -> None:
    x = np.array([[1.0, 2, 5], [0, 1, 1]])
    drain(worker, connection, positions(1, x))
    drain(worker, connection, positions(2, 2 * x))
    assert [answer.failure for answer, _ in connection.answers] == ["", ""]
    assert np.frombuffer(connection.answers[0][1], np.float32).tolist() == [4, 4, 4, 2, 2, 2]
    assert (Doubling.made, connection.asked.count(("scene", 0))) == (1, 1), "the description is asked for once"
    drain(worker, connection, matrix(3, scale=9.0))
    assert np.frombuffer(connection.answers[2][1], np.float32).tolist() == [3] * 6


def test_a_new_server_is_asked_for_its_scene_again(worker: Worker, connection: FakeConnection, doubling: None) -> None:
    x = np.ones((2, 3))
    drain(worker, connection, positions(1, x))
    connection.received.put(ServerGone(7))
    connection.received.put(ServersThere((7,)))
    worker.step(0.0)
    drain(worker, connection, positions(2, x))
    assert Doubling.made == 2


@pytest.mark.parametrize(("change", "words"), [({"checksum": 1}, "checksum"), ({"nodes": 3}, "positions|bytes")])
def test_bad_positions_are_answered_with_the_reason(
    worker: Worker, connection: FakeConnection, doubling: None, change: dict, words: str
) -> None:
    drain(worker, connection, positions(1, np.ones((2, 3)), **change))
    assert re.search(words, connection.answers[0][0].failure)


def test_a_scene_that_cannot_be_built_is_answered_with_the_reason(worker: Worker, connection: FakeConnection) -> None:
    drain(worker, connection, positions(1, np.ones((2, 3))))
    assert "Topology.rest" in connection.answers[0][0].failure


def test_the_newest_matrix_of_an_object_wins(worker: Worker, connection: FakeConnection) -> None:
    drain(worker, connection, matrix(1), matrix(2, "liver"), matrix(3), matrix(4), matrix(2))
    assert [(answer.header.object, answer.job) for answer, _ in connection.answers] == [("beam", 4), ("liver", 2)]
    assert connection.counters.superseded == 3


def test_the_symbolic_phase_is_done_once_per_epoch(worker: Worker, connection: FakeConnection) -> None:
    for number, epoch in enumerate((1, 1, 2, 2), start=1):
        drain(worker, connection, matrix(number, epoch=epoch))
    assert connection.asked == [("beam", 1), ("beam", 2)]
    assert len(connection.answers) == 4


def test_another_method_is_another_analysis(connection: FakeConnection) -> None:
    made = []
    worker = Worker(connection, lambda *given: made.append(Diagonal(*given)) or made[-1])  # type: ignore
    connection.received.put(ServersThere((7,)))
    worker.step(0.0)
    asked = {"method": "incomplete_cholesky", "drop_tolerance": 0.25, "fill": 3.0, "omega": 1.0}
    for number, changes in enumerate(({}, asked, asked, asked | {"fill": 4.0}), start=1):
        drain(worker, connection, matrix(number, **changes))
    assert [m.method.name for m in made] == ["cholesky", "incomplete_cholesky", "incomplete_cholesky"]
    assert made[1].method == Method("incomplete_cholesky", drop_tolerance=0.25, fill=3.0)
    made[2].remedy = "diagonal shifted by 1"
    drain(worker, connection, matrix(5, **asked | {"fill": 4.0}))
    assert [answer.remedy for answer, _ in connection.answers] == ["", "", "", "", "diagonal shifted by 1"]


def test_a_pattern_that_the_server_knows_is_not_sent_again(worker: Worker, connection: FakeConnection) -> None:
    drain(worker, connection, matrix(1))
    known = connection.answers[0][0].pattern
    sent = []
    for number, patterns in enumerate(([known], [], [known + 1, known]), start=2):
        before = len(connection.patterns)
        drain(worker, connection, matrix(number, known_patterns=patterns))
        sent.append(len(connection.patterns) - before)
    assert [answer.job for answer, _ in connection.answers] == [1, 2, 3, 4]
    assert sent == [0, 1, 0], "the third job says that the server forgot it"


def test_what_cannot_be_factorized_is_answered_with_the_reason(worker: Worker, connection: FakeConnection) -> None:
    drain(worker, connection, matrix(1, scale=-1.0))
    drain(worker, connection, matrix(2, checksum=5))
    drain(worker, connection, matrix(3, "unknown"))
    drain(worker, connection, matrix(4, blocks=3))
    reasons = [answer.failure for answer, data in connection.answers if data == b""]
    assert len(reasons) == 4
    for reason, text in zip(
        reasons, ("positive definite", "checksum", "no topology", "Matrix.blocks is 3"), strict=True
    ):
        assert text in reason


class Failing(Diagonal):
    """Its first factorization fails in a way that may pass, or for good."""

    error: Exception = MemoryError("GPU memory: this object needs 3.00 GiB, 1.00 of 8.0 GiB are free")

    def factorize(self, values: np.ndarray, dtype: Any) -> np.ndarray:
        if (error := Failing.error) is not None:
            Failing.error = None  # type: ignore[assignment]
            raise error
        return super().factorize(values, dtype)


def test_too_little_memory_for_one_object_is_told_and_the_worker_lives_on(connection: FakeConnection) -> None:
    worker = Worker(connection, Failing)  # type: ignore[arg-type]
    connection.received.put(ServersThere((7,)))
    drain(worker, connection, matrix(1), matrix(2, "liver"))
    (refused, _), (answered, _) = connection.answers
    assert refused.header.object == "beam" and "needs 3.00 GiB" in refused.failure
    assert answered.header.object == "liver" and not answered.failure
    assert (connection.counters.failures, connection.counters.jobs) == (1, 2)


def test_a_device_that_fails_ends_the_worker_after_an_answer(connection: FakeConnection) -> None:
    Failing.error = DeviceUnusable("the GPU failed: cudaErrorIllegalAddress")
    worker = Worker(connection, Failing)  # type: ignore[arg-type]
    connection.received.put(ServersThere((7,)))
    with pytest.raises(DeviceUnusable):
        drain(worker, connection, matrix(1))
    assert [answer.failure for answer, _ in connection.answers] == ["the GPU failed: cudaErrorIllegalAddress"]


class Unreadable:
    """Device memory that can be opened, and then is not there."""

    def address(self, slot: DeviceSlot, size: int) -> int:
        return 4096

    def read(self, address: int, dtype: Any, count: int) -> np.ndarray:
        raise Refused("DeviceSlot cannot be copied from or to: cudaErrorInvalidValue", "slot")


def test_device_memory_that_cannot_be_read_is_left(worker: Worker, connection: FakeConnection) -> None:
    """Else each job of the object would fail so."""
    left: list[str] = []
    connection.device, connection.leave_device = Unreadable(), left.append  # type: ignore[attr-defined]
    slot = DeviceSlot(handle=b"h" * 64, capacity=4096, generation=1)
    drain(worker, connection, matrix(device_matrix=slot, device_factor=slot))
    assert [answer.failure for answer, _ in connection.answers] == left and "cannot be copied" in left[0]


def test_a_large_factor_is_kept_to_be_asked_for_in_parts(worker: Worker, connection: FakeConnection) -> None:
    """Six values of four bytes: parts of 4 bytes are six, of 8 bytes three, and up to four travel whole."""
    drain(worker, connection, matrix(part_bytes=4))
    answer, payload = connection.answers[0]
    job, values = connection.offered.kept["beam"]
    assert (job, payload, answer.checksum) == (1, b"", 0)
    assert list(answer.parts) == [checksum(value.tobytes()) for value in values] and len(values) == 6
    drain(worker, connection, matrix(2, scale=9.0, part_bytes=8))
    answer, payload = connection.answers[1]
    assert list(answer.parts) == [] and np.array_equal(np.frombuffer(payload, np.float32), np.full(6, 3.0, np.float32))
    assert connection.offered.kept == {}, "the server has had the one before, or has given it up"


def test_an_older_server_has_every_factor_whole(worker: Worker, connection: FakeConnection) -> None:
    drain(worker, connection, matrix())
    assert not connection.answers[0][0].parts and len(connection.answers[0][1]) == 24


def test_factors_of_a_server_that_is_gone_are_dropped(worker: Worker, connection: FakeConnection) -> None:
    drain(worker, connection, matrix(part_bytes=4))
    connection.received.put(ServerGone(7))
    worker.step(0.0)
    assert connection.offered.kept == {}


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"header": Header(protocol=PROTOCOL + 1, incarnation=7, object="beam")}, "version"),
        ({"header": Header(protocol=PROTOCOL, incarnation=6, object="beam")}, "incarnation"),
        ({"worker": "x"}, "worker"),
        ({"factor_dtype": "float16"}, "malformed"),
        ({"method": "lu"}, "malformed"),
        ({"method": "ssor", "omega": 2.5}, "malformed"),
        ({"method": "incomplete_cholesky", "drop_tolerance": float("nan")}, "malformed"),
    ],
)
def test_what_is_not_for_it_is_dropped_and_counted(
    worker: Worker, connection: FakeConnection, changes: dict[str, Any], kind: str
) -> None:
    drain(worker, connection, matrix(1, **changes), matrix(2))
    assert connection.counters.refusals == {kind: 1}
    assert [answer.job for answer, _ in connection.answers] == [2]


def test_a_new_server_means_new_analyses_and_old_work_is_dropped(worker: Worker, connection: FakeConnection) -> None:
    drain(worker, connection, matrix(1))
    drain(worker, connection, matrix(2), ServersThere((8,)), matrix(3))  # type: ignore[arg-type]
    assert connection.incarnation == 8
    assert [answer.job for answer, _ in connection.answers] == [1]
    assert connection.counters.superseded == 1 and connection.counters.refusals == {"incarnation": 1}
    drain(worker, connection, ServerGone(7))  # type: ignore[arg-type]
    assert connection.incarnation == 8
    drain(worker, connection, ServerGone(8))  # type: ignore[arg-type]
    assert connection.incarnation == 0


def test_it_stays_with_the_life_of_the_server_that_answers(worker: Worker, connection: FakeConnection) -> None:
    drain(worker, connection, matrix(1))
    drain(worker, connection, ServersThere((9, 7)), matrix(2))  # type: ignore[arg-type]
    assert connection.incarnation == 7 and [answer.job for answer, _ in connection.answers] == [1, 2]
    drain(worker, connection, ServerGone(9))  # type: ignore[arg-type]
    assert connection.incarnation == 7
    connection.without_token = {9}
    drain(worker, connection, ServersThere((9, 8)))  # type: ignore[arg-type]
    assert connection.incarnation == 8, "7 answers no more; 9 has no token"
    drain(worker, connection, ServersThere((9,)))  # type: ignore[arg-type]
    assert connection.incarnation == 8


def test_a_full_mailbox_drops_the_oldest_and_counts() -> None:
    received: ReceiveQueue[int] = ReceiveQueue(3)
    for number in range(5):
        received.put(number)
    assert received.take(0.0) == [2, 3, 4] and received.dropped == 2
    assert received.take(0.0) == []
