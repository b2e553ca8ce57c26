# SPDX-License-Identifier: MIT
"""Patterns of factors on disk, by which a server plans inverses before its first factor comes."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocol.factor import FactorPattern
from protocol.messages_pb2 import Header
from sim_server.backends.gpu import known_patterns
from sim_server.backends.gpu.known_patterns import LEAST_NODES, KnownPatterns

NODES = LEAST_NODES + 5


class Planner:
    """Does at once what is to be done beside. planned: bodies and patterns"""

    def __init__(self) -> None:
        self.planned: list[tuple[int, int]] = []

    def beside(self, work: Callable[[], Any]) -> None:
        work()

    def expect(self, body: int, pattern: FactorPattern) -> None:
        self.planned.append((body, pattern.id))


def pattern(nodes: int = NODES, shift: int = 0) -> FactorPattern:
    """Of a diagonal matrix, each node a supernode."""
    n = np.arange(3 * nodes)
    starts = 3 * np.arange(nodes + 1)
    return FactorPattern.build(np.roll(n, shift), starts, starts, n)


def scene(first: int = 0) -> tuple[Planner, KnownPatterns]:
    """Two bodies with one pattern of A, behind `first` nodes, and a small one."""
    start = np.arange(first + 2 * NODES + 10, dtype=np.int32)
    ranges = [(first, first + NODES), (first + NODES, first + 2 * NODES), (first + 2 * NODES, len(start) - 1)]
    planner = Planner()
    return planner, KnownPatterns(planner, planner.expect, ranges, start, start[:-1])  # type: ignore[arg-type]


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("WARPFACTOR_CACHE", str(tmp_path))
    return tmp_path / "patterns"


def test_what_came_is_planned_at_the_next_start(folder):
    planner, known = scene()
    known.plan()
    known.note(0, pattern())
    known.note(2, pattern(9))
    assert planner.planned == [] and len(list(folder.iterdir())) == 1, "a small body is not worth it"
    planner, known = scene(first=7)
    known.plan()
    assert planner.planned == [(0, pattern().id), (1, pattern().id)], "bodies with one pattern of A share it"


def test_the_first_one_of_a_run_is_kept(folder):
    """Others come from other libraries, or are of incomplete factors, each of which has its own."""
    _, known = scene()
    known.note(0, pattern())
    known.note(0, pattern(shift=3))
    (path,) = folder.iterdir()
    written = path.read_bytes()
    os.utime(path, ns=(1, 1))
    scene()[1].note(0, pattern(shift=3))
    assert path.read_bytes() != written


def short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-4])


def changed(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-4] + b"\0\0\0\0")


def of_another(path: Path) -> None:
    """A pattern that is right, of another body."""
    path.write_bytes(pattern(NODES - 1).message(Header()).SerializeToString())


@pytest.mark.parametrize("spoil", [short, changed, of_another, lambda p: p.write_bytes(b""), lambda p: p.chmod(0o622)])
def test_what_cannot_be_trusted_counts_as_not_there(folder, spoil):
    scene()[1].note(0, pattern())
    (path,) = folder.iterdir()
    spoil(path)
    planner, known = scene()
    known.plan()
    assert planner.planned == []
    known.note(0, pattern())
    known.plan()
    assert planner.planned == [(0, pattern().id), (1, pattern().id)]


def test_files_used_longest_ago_go_when_there_are_too_many_bytes(folder, monkeypatch):
    scene()[1].note(0, pattern())
    (path,) = folder.iterdir()
    os.utime(path, (1, 1))
    monkeypatch.setattr(known_patterns, "MOST_BYTES", path.stat().st_size)
    start = np.arange(NODES + 1, dtype=np.int32)
    planner = Planner()
    KnownPatterns(planner, planner.expect, [(0, NODES)], 2 * start, np.repeat(start[:-1], 2)).note(0, pattern())  # type: ignore[arg-type]
    assert not path.exists() and len(list(folder.iterdir())) == 1
