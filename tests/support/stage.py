# SPDX-License-Identifier: MIT
"""A real server with a log, real workers on a port of their own, and what the log says afterwards."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from clients.client import Client
from clients.errors import ClientError
from tests.ports import free_endpoint

DT = 0.02  # s
SCENE = f"""
dt = {DT}
[effects]
gravity = {{ g = [0, -9.81, 0] }}
[solver]
preconditioner = "cholesky"
[[object]]
name = "beam"
mesh = {{ bar = [4, 4, 12], size = [1, 1, 4], split = "kuhn" }}
elements = "linear"
[object.effects]
corotational = {{ young = 1e6, poisson = 0.4 }}
fixed = {{ where = "Z < 0.01" }}
touch = true
"""
PATIENCE = 60.0  # s


class Stage:
    """One server in real time that swings a beam until it is told to stop; all processes end with it.

    scene: with an object "beam"; host: where it listens; far: words before a worker's command line, such as
    those that put it elsewhere; device: of the server.
    """

    def __init__(self, host: str = "127.0.0.1", far: Sequence[str] = (), device: str = "cpu", scene: str = SCENE):
        self.endpoint = free_endpoint(host)
        self._far = list(far)
        self._folder = tempfile.TemporaryDirectory(prefix="warpfactor-faults-")
        self.log = Path(self._folder.name) / "run.mcap"
        file = Path(self._folder.name) / "beam.toml"
        file.write_text(scene)
        self._processes: list[subprocess.Popen[bytes]] = []
        words = [str(file), "--listen", self.endpoint, "--record", str(self.log), "--quiet", "--device", device]
        words += [] if host == "127.0.0.1" else ["--insecure"]
        self.server = self.start(tool("sim_server", *words))

    def start(self, command: Sequence[str]) -> "subprocess.Popen[bytes]":
        """A process that ends with the stage."""
        out = (Path(self._folder.name) / "output").open("ab")
        stacks = {**os.environ, "PYTHONFAULTHANDLER": "1"}  # for `stacks`
        process = subprocess.Popen(command, stdout=out, stderr=out, env=stacks)
        out.close()
        self._processes.append(process)
        return process

    def worker(self, name: str, *options: str) -> "subprocess.Popen[bytes]":
        """One more worker."""
        words = ["--connect", self.endpoint, "--name", name, *options]
        return self.start([*self._far, *tool("precond_worker", *words)])

    def client(self) -> Client:
        """Once the server is up."""
        end = time.monotonic() + PATIENCE
        while True:
            try:
                client = Client(connect=[self.endpoint], timeout=1.0)
                client.status()
                return client
            except ClientError:
                if time.monotonic() > end or self.server.poll() is not None:
                    raise

    def finish(self, client: Client) -> dict[str, np.ndarray]:
        """Stops the server; the scalars of all steps."""
        client.stop()
        code = self.server.wait(PATIENCE)
        if code:
            raise RuntimeError(f"the server ended with {code}: {self.output()[-2000:]}")
        arrays = self.log.with_suffix(".npz")
        command = tool("clients", "export", str(self.log), "--object", "beam", "--to", str(arrays))
        subprocess.run(command, check=True, capture_output=True)
        with np.load(arrays) as data:
            return {name.removeprefix("scalars/"): data[name] for name in data.files if name.startswith("scalars/")}

    def output(self) -> str:
        """Of all processes."""
        return (Path(self._folder.name) / "output").read_text()

    def stacks(self) -> str:
        """Ends all processes; what they did, for a test that waited in vain."""
        ends = []
        for process in reversed(self._processes):  # the server's last, since the end of the output is shown
            ended = process.poll()
            process.send_signal(signal.SIGCONT)
            process.send_signal(signal.SIGABRT)  # prints what its threads do
            process.wait()
            ends.append(f"{' '.join(process.args[:3])}: {'running' if ended is None else f'had ended with {ended}'}")
        return "\n".join([*ends, self.output()[-8000:]])

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        for process in self._processes:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
            process.wait()
        self._folder.cleanup()


def tool(package: str, *arguments: str) -> list[str]:
    """Command line of one of our programs."""
    return [sys.executable, "-m", package, *arguments]


class Progress:
    """What the server reports while it runs."""

    def __init__(self, stage: Stage, client: Client):
        self._stage, self._client = stage, client
        self._steps = client.steps()
        self.step, self.factor_step = 0, -1

    def look(self) -> None:
        """Take in the newest records."""
        for record in self._steps.new():
            self.step, self.factor_step = record.step, max(self.factor_step, record.factor_step)

    def until(self, holds: Any, seconds: float | None = None) -> None:
        """Look until a condition holds; raises TimeoutError. Without `seconds` that ends the stage with its stacks."""
        end = time.monotonic() + (seconds or PATIENCE)
        while not holds():
            if time.monotonic() > end:
                more = self._server() if seconds is None else ""
                raise TimeoutError(f"waited {seconds or PATIENCE:g} s at step {self.step}{more}")
            time.sleep(0.01)
            self.look()

    def _server(self) -> str:
        try:
            at = f"the server says that it is at step {self._client.status().step}"
        except ClientError as error:
            at = str(error)
        return f"; {at}\n{self._stage.stacks()}"

    def past(self, step: int) -> None:
        """Look until the run is past a step."""
        self.until(lambda: self.step >= step)

    def pause(self, seconds: float) -> None:
        """Let time pass, looking."""
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end, seconds + 1)


def measured(data: dict[str, np.ndarray], seen: int, after: int | None) -> dict[str, Any]:
    """One row. seen: the last step that a client heard of; after: step at which the fault was over (None: there was
    none)."""
    iterations, made = data["iterations"], data["factor_step"]
    steps = max(seen, int(data["step"].max()))
    fresh = np.flatnonzero(made > after) if after is not None else np.zeros(0, int)
    return {
        "steps": steps,
        "missed": steps - len(np.unique(data["step"])),
        "not converged": int(np.sum(data["status"] != "converged")),
        "step p50 ms": 1e3 * float(np.median(data["step_seconds"])),
        "step max ms": 1e3 * float(data["step_seconds"].max()),
        "step CPU max ms": 1e3 * float(data["cpu_seconds"].max()),
        "latest start ms": 1e3 * float(data["late_seconds"].max()),
        "late steps": int(np.sum(data["late_seconds"] > 1e-3)),
        "iterations": float(iterations[made >= 0].mean()),  # of steps with a factor: how long a start takes varies
        "iterations max": int(iterations[made >= 0].max()),
        "oldest factor": int(data["factor_age"].max()),
        "next factor s": float(DT * (data["step"][fresh[0]] - after)) if len(fresh) and after is not None else None,
    }
