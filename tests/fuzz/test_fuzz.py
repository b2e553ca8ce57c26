# SPDX-License-Identifier: MIT
"""A few hostile inputs of each kind, and all that were findings. Many more: `deploy/run bench fuzz --minutes N`."""

import random
from pathlib import Path

import pytest

from protocol.channels import MIB
from tests.bench.fuzz.__main__ import tried
from tests.fuzz import targets
from tests.fuzz.found import FOLDER, keep, kept
from tests.fuzz.inputs import KINDS, logs, made, meshes
from tests.fuzz.targets import TooLong, accepted, in_time

CASES = sorted(FOLDER.glob("*-*"))
FEW = 40


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("kind", KINDS)
def test_hostile_inputs_are_taken_or_refused_in_words(kind: str, tmp_path: Path) -> None:
    outcomes = {accepted(kind, made(kind, seed), tmp_path) for seed in range(FEW)}
    assert outcomes, "read to the end"


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("path", CASES, ids=lambda path: path.name)
def test_what_was_found(path: Path, tmp_path: Path) -> None:
    kind, given = kept(path)
    accepted(kind, given, tmp_path)


@pytest.mark.filterwarnings("ignore")
def test_unchanged_files_are_accepted(tmp_path: Path) -> None:
    assert all(accepted("mesh", given, tmp_path) for given in meshes())
    assert all(accepted("log", data, tmp_path) for data in logs())


@pytest.mark.parametrize("kind", KINDS)
def test_an_input_is_that_of_its_seed_and_is_kept_as_it_is(kind: str, tmp_path: Path) -> None:
    assert made(kind, 3) == made(kind, 3) != made(kind, 4)
    assert kept(keep(kind, 3, tmp_path)) == (kind, made(kind, 3))


def test_what_must_not_be_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def reader(data: bytes, folder: Path) -> bool:
        if random.Random(data).random() < 0.5:
            raise KeyError("a row that is not there")
        return True

    monkeypatch.setitem(targets.TARGETS, "log", reader)
    got = tried("log", 0, 20)
    assert got["found"] and got["accepted"] and got["inputs"] == 20 and "KeyError" in got["found"][0][1]


def test_a_crash_is_told_with_its_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    import os
    import signal

    wanted = made("log", 7)
    monkeypatch.setitem(
        targets.TARGETS, "log", lambda data, folder: data != wanted or os.kill(os.getpid(), signal.SIGKILL)
    )
    assert tried("log", 0, 20)["found"] == [(7, "ended by SIGKILL")]


def test_what_takes_too_long_is_told() -> None:
    with pytest.raises(TooLong), in_time(1):
        while True:
            pass


def test_messages_are_small() -> None:
    assert max(len(made("wire", seed)[1]) for seed in range(200)) < MIB
