# SPDX-License-Identifier: MIT
"""Compilers at work: shared libraries are made several at a time, begun before anybody waits for one of them."""

import atexit
import contextlib
import os
import signal
import subprocess
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from protocol.process.cache_folder import unfinished
from sim_server.backends.cpu.processors import usable_processors

LOOK = 5e-3  # s between looks at the compilers that run
KEPT = 0.3  # s that it takes at most to fetch a kernel from a cache
PATIENCE = 2.0  # s for a compiler to end when told
Progress = Callable[[int, int], None]


class CompileError(RuntimeError):
    """The C++ compiler is missing or refused a text; the message holds its output."""


@dataclass(frozen=True)
class Job:
    """A shared library to make. command: without its -o. text: what the compiler reads where no file holds it."""

    name: str
    library: Path
    command: list[str]
    text: str | None = None

    @property
    def scratch(self) -> Path:
        """Where the compiler writes."""
        return unfinished(self.library)


@dataclass(frozen=True)
class Running:
    """A compiler at work on a job. said: the file of its messages."""

    job: Job
    process: "subprocess.Popen[bytes]"
    said: IO[bytes]


class Compilers:
    """Runs up to `cores` compilers at a time.

    progress: called while somebody waits, with the number of texts compiled and of all asked for (0: not known), both
    counted since somebody last waited until there was nothing to do.
    """

    def __init__(self, cores: int):
        self.cores = cores
        self.progress: Progress | None = None
        self._lock = threading.Lock()
        self._waiting: deque[Job] = deque()
        self._running: dict[Path, Running] = {}
        self._failed: dict[Path, str] = {}
        self._done = self._total = 0
        self._told = False  # somebody has waited since they were counted anew

    @property
    def running(self) -> int:
        """Number of compilers that have not ended. A probe for tests."""
        with self._lock:
            return sum(running.process.poll() is None for running in self._running.values())

    def begin(self, job: Job) -> None:
        """Starts a compiler now or once one of the others has ended; returns at once."""
        with self._lock:
            if job.library in self._running or any(job.library == other.library for other in self._waiting):
                return
            if self._told and not self._waiting and not self._running:
                self._done, self._total, self._told = 0, 0, False
            self._failed.pop(job.library, None)
            self._waiting.append(job)
            self._total += 1
            self._turn()

    def finish(self, library: Path) -> None:
        """Waits until it is made, if it was begun; raises CompileError with the compiler's output."""
        waited = False
        while not self._finished(library):
            waited = True
            if self.progress is not None:
                self.progress(self._done, self._total)
            time.sleep(LOOK)
        self._told = self._told or waited
        if waited and self.progress is not None:
            self.progress(self._done, self._total)

    @contextmanager
    def counted(self) -> Iterator[None]:
        """Counts a kernel that another compiler makes within the context, unless it was in that compiler's cache."""
        begun = time.monotonic()
        yield
        if time.monotonic() - begun > KEPT and self.progress is not None:
            self._done += 1
            self.progress(self._done, 0)

    def stop(self) -> None:
        """Ends all compilers; what they have not made yet is not made."""
        with self._lock:
            self._waiting.clear()
            self._turn()
            for running in self._running.values():
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(running.process.pid, signal.SIGTERM)
            for running in self._running.values():
                try:
                    running.process.wait(PATIENCE)
                except subprocess.TimeoutExpired:
                    os.killpg(running.process.pid, signal.SIGKILL)
                running.job.scratch.unlink(missing_ok=True)
            self._running.clear()

    def _finished(self, library: Path) -> bool:
        with self._lock:
            self._turn()
            if library in self._failed:
                raise CompileError(self._failed[library])
            return library not in self._running and all(library != job.library for job in self._waiting)

    def _turn(self) -> None:
        """Collects compilers that have ended and starts those there is room for."""
        for running in [r for r in self._running.values() if r.process.poll() is not None]:
            del self._running[running.job.library]
            self._collect(running)
            self._done += 1
        while self._waiting and len(self._running) < self.cores:
            job = self._waiting.popleft()
            self._running[job.library] = _start(job)

    def _collect(self, running: Running) -> None:
        job = running.job
        with running.said as file:
            if running.process.returncode:
                file.seek(0)
                said = file.read().decode(errors="replace")
                self._failed[job.library] = f"{job.name} did not compile:\n{' '.join(job.command)}\n{said}"
                job.scratch.unlink(missing_ok=True)
            else:
                os.replace(job.scratch, job.library)


def _start(job: Job) -> Running:
    said = tempfile.TemporaryFile()  # noqa: SIM115  _collect closes it. No pipe: nobody reads while it runs
    with tempfile.TemporaryFile() as text:
        text.write((job.text or "").encode())
        text.seek(0)
        process = subprocess.Popen(
            [*job.command, "-o", str(job.scratch)], stdin=text, stdout=said, stderr=said,
            start_new_session=True,  # stop() ends the compiler proper too, which the command starts
        )  # fmt: skip
    return Running(job, process, said)


compilers = Compilers(usable_processors())
atexit.register(compilers.stop)
