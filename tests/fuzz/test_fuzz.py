# SPDX-License-Identifier: MIT
"""A few hostile inputs of each kind, and all that were findings. Many more: `deploy/run bench fuzz --minutes N`."""

from pathlib import Path

import pytest

from protocol.channels import MIB
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


def test_what_takes_too_long_is_told() -> None:
    """Also where what reads an input takes every exception for a damaged one."""
    with pytest.raises(TooLong), in_time(1):
        try:
            while True:
                pass
        except Exception:
            pytest.fail("taken for a damaged input")


def test_messages_are_small() -> None:
    assert max(len(made("wire", seed)[1]) for seed in range(200)) < MIB
