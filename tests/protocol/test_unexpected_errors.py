# SPDX-License-Identifier: MIT
"""Warnings about errors that no check foresees."""

import logging

import pytest

from protocol.counters import MAX_PLACES, Counters


def refuse(counters: Counters, code: str, line: int) -> None:
    try:
        exec(compile("\n" * line + code, "module.py", "exec"))
    except Exception as error:
        counters.refuse(counters.unexpected(error, "a message"))


def test_each_place_is_told_once_and_few_of_them(caplog: pytest.LogCaptureFixture) -> None:
    counters = Counters(logging.getLogger("test"))
    for line in (4, 4, 7, 4, 7):
        refuse(counters, "[][0]", line)
    refuse(counters, "1 / 0", 7)
    told = [record.getMessage().split(" (counted")[0] for record in caplog.records]
    assert [each.split("a message: ")[1] for each in told] == [
        "IndexError: list index out of range (module.py:5)",
        "IndexError: list index out of range (module.py:8)",
        "ZeroDivisionError: division by zero (module.py:8)",
    ]
    for line in range(100, 200):
        refuse(counters, "[][0]", line)
    assert len(caplog.records) == MAX_PLACES and counters.refusals == {"unexpected": 106}
