# SPDX-License-Identifier: MIT
"""A real server with a worker and an honest client, and what becomes of them when somebody attacks."""

import contextlib
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from clients.client import Client
from clients.errors import BadInput, ClientError
from protocol import messages_pb2 as pb
from protocol.network.identity import identity_of
from protocol.process.own_python import own_module
from tests.attacks.attacks import Attack, Attacker, Victim
from tests.ports import free_endpoint

SCENE = """
dt = 0.02
[effects]
gravity = { g = [0, -9.81, 0] }
[solver]
preconditioner = "cholesky"
[[object]]
name = "beam"
mesh = { bar = [3, 3, 10], size = [1, 1, 4], split = "kuhn" }
[object.effects]
corotational = { young = 1e6, poisson = 0.4 }
rayleigh = { mass = 0.1 }
fixed = { where = "Z < 0.01" }
touch = true
"""
TOLERANCE = 1e-6  # of the scene: the default
PATIENCE = 60.0  # s


@dataclass
class Outcome:
    """What came of an attack.

    refused_honest: answers that the honest client did not get, or that were another's
    strangers: steps, states and statuses that the client took from somebody else
    first, last: steps between which it was; seconds: from its end to the next factor that was made and used
    session: seconds from its end until somebody new has got in
    """

    refused_honest: int
    strangers: int
    first: int
    last: int
    seconds: float
    session: float


class Arena:
    """Use it as a context manager. tls: with certificates, and the attacker is a viewer; else all are bare."""

    def __init__(self, tls: bool = False):
        self._closing = contextlib.ExitStack()
        self.folder = Path(self._closing.enter_context(tempfile.TemporaryDirectory(prefix="warpfactor-attacks-")))
        self.tls, self.log = tls, self.folder / "run.mcap"
        self.endpoint = free_endpoint(protocol="tls" if tls else "tcp")
        self._beside = free_endpoint(protocol="tls" if tls else "tcp")
        self._certs = self.folder / "certs"
        (self.folder / "scene.toml").write_text(SCENE)
        words = ["--listen", self.endpoint, "--listen", self._beside, "--workers", "1", "--device", "cpu"]
        words += ["--record", str(self.log)]
        if tls:
            self._run("sim_server", "certs", str(self._certs), "--host", "localhost")
            words += ["--tls", str(self._certs)]
        out = self._closing.enter_context((self.folder / "server.log").open("wb"))
        self.server = subprocess.Popen(
            own_module("sim_server", str(self.folder / "scene.toml"), *words), stdout=out, stderr=out
        )
        self._closing.callback(self._end)
        self.client = self._closing.enter_context(contextlib.closing(self._connected()))
        self._steps, self._states = self.client.steps(), self.client.states()
        self.scene = self.client.status().scene
        self._wait(lambda: self._factor() > 0, "the first factor")
        self.grab = self.client.grab("beam", at="tip", stiffness=100.0, max_force=10.0)

    def _run(self, package: str, *words: str) -> None:
        subprocess.run(own_module(package, *words), check=True, capture_output=True)

    def _connected(self) -> Client:
        end = time.monotonic() + PATIENCE
        while True:
            try:
                found = Client(connect=[self.endpoint], timeout=1.0, tls=self._certs if self.tls else None)
                found.timeout = 20.0
                return found
            except ClientError:
                if self.server.poll() is not None or time.monotonic() > end:
                    raise AssertionError(self.output()) from None

    def output(self) -> str:
        """What the server said."""
        return (self.folder / "server.log").read_text(errors="replace")

    def _wait(self, holds: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + PATIENCE
        while not holds():
            assert self.server.poll() is None, f"the server has ended: {self.output()[-3000:]}"
            assert time.monotonic() < end, f"not within {PATIENCE:g} s: {what}"
            time.sleep(0.02)

    def _factor(self) -> int:
        """The step whose matrix the factor in use was made from."""
        return self.client.status(fresh=True).objects[0].last.factor_step

    def victim(self) -> Victim:
        """What anybody reads of the honest in the status."""
        status = self.client.status(fresh=True)
        worker = status.workers[0] if status.workers else pb.WorkerInfo()
        held = self.grab.interaction.id
        return Victim(
            status.header.incarnation, self.client.id, held, worker.worker, worker.pid, worker.host, self._beside
        )

    def meet(self, attack: Attack) -> Outcome:
        """Makes an attack while the honest client works; returns what became of it once a new factor is in use."""
        lost, first = 0, self.client.status(fresh=True).step
        self._strangers()
        attacker = Attacker(self.endpoint, self.victim(), self._identity())
        try:
            attack(attacker)
            lost += self._honest()
        finally:
            attacker.close()
        end, began = self.client.status(fresh=True).step, time.monotonic()
        self._wait(lambda: self._factor() > end, "a factor that was made after the attack")
        factor = time.monotonic() - began
        lost += self._honest()
        self._connected().close()
        session, last = time.monotonic() - began, self.client.status(fresh=True).step
        return Outcome(lost, self._strangers(), first, last, factor, session)

    def _identity(self):  # type: ignore[no-untyped-def]
        return identity_of(self._certs / "viewer", ()) if self.tls else None

    def _honest(self) -> int:
        """Uses the server; returns how often it did not do what it was asked."""
        lost = 0
        for use in (self._looks, self._moves, self._pushes):
            try:
                use()
            except (AssertionError, ClientError, BadInput):
                lost += 1
        return lost

    def _looks(self) -> None:
        found = self.client.status(fresh=True)
        assert found.scene == self.scene and found.state == "running" and found.objects[0].object == "beam"

    def _moves(self) -> None:
        self.grab.move((0.5, 0.5, 4.0))

    def _pushes(self) -> None:
        """Within 2 s: a server that has too much to do says so, and is asked again."""
        end = time.monotonic() + 2.0
        while True:
            try:
                assert self.client.push("beam", at="tip", force=(1.0, 0, 0), duration=0.02).nodes == 1
                return
            except BadInput:
                if time.monotonic() > end:
                    raise
                time.sleep(0.05)

    def _strangers(self) -> int:
        """Returns how many steps and states came since the last call that the server did not make."""
        now = self.client.status(fresh=True).step + 1000
        steps = sum(not 0 <= step.step < now for step in self._steps.new())
        return steps + sum(not 0 <= frame.step < now for frame in self._states.newest())

    def judged(self) -> "Judgement":
        """Ends the server and reads its log."""
        self.grab.release()
        self.client.stop()
        assert self.server.wait(PATIENCE) == 0, self.output()[-3000:]
        return Judgement(self.log)

    def _end(self) -> None:
        if self.server.poll() is None:
            self.server.terminate()
            try:
                self.server.wait(10.0)
            except subprocess.TimeoutExpired:
                self.server.kill()
                self.server.wait()

    def __enter__(self) -> "Arena":
        return self

    def __exit__(self, *_: object) -> None:
        self._closing.close()


class Judgement:
    """Steps of a log: which are there, and which are right."""

    def __init__(self, log: Path):
        numbers, residuals, statuses, iterations = [], [], [], []
        for step in _steps(log):
            numbers.append(step.step)
            residuals.append(step.residual)
            statuses.append(step.status)
            iterations.append(step.iterations)
        self.numbers = np.array(numbers, np.int64)
        self._wrong = np.array(statuses) != pb.CONVERGED
        self._wrong |= ~(np.array(residuals) <= TOLERANCE)
        self.iterations = np.array(iterations)

    def missing(self, first: int, last: int) -> int:
        """Steps after `first` up to `last` that the log does not hold."""
        return last - first - int(self._between(first, last).sum())

    def wrong(self, first: int, last: int) -> int:
        """Steps whose true residual is above the tolerance, or that did not converge."""
        return int(self._wrong[self._between(first, last)].sum())

    def mean_iterations(self, first: int, last: int) -> float:
        """Iterations of a step."""
        return float(self.iterations[self._between(first, last)].mean())

    def _between(self, first: int, last: int) -> np.ndarray:
        return (self.numbers > first) & (self.numbers <= last)


def _steps(log: Path) -> Iterator[pb.ObjectStep]:
    with log.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            if channel.topic == "/step/beam":
                yield pb.ObjectStep.FromString(message.data)
