# SPDX-License-Identifier: MIT
"""The bench of hostile inputs tells what it finds."""

import os
import random
import signal
from pathlib import Path

import pytest

from tests.bench.fuzz.__main__ import tried
from tests.fuzz import targets
from tests.fuzz.inputs import made


def test_what_must_not_be_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def reader(data: bytes, folder: Path) -> bool:
        if random.Random(data).random() < 0.5:
            raise KeyError("a row that is not there")
        return True

    monkeypatch.setitem(targets.TARGETS, "log", reader)
    got = tried("log", 0, 20)
    assert got["found"] and got["accepted"] and got["inputs"] == 20 and "KeyError" in got["found"][0][1]


def test_a_crash_is_told_with_its_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    wanted = made("log", 7)
    monkeypatch.setitem(
        targets.TARGETS, "log", lambda data, folder: data != wanted or os.kill(os.getpid(), signal.SIGKILL)
    )
    assert tried("log", 0, 20)["found"] == [(7, "ended by SIGKILL")]
