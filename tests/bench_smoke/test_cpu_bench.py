# SPDX-License-Identifier: MIT
"""Rows of the CPU benchmark on a machine that has other work."""

from tests.bench.cpu.__main__ import WALL, without_wall


def test_a_busy_machine_tells_no_wall_times() -> None:
    row = {"scheme": "async + warp", "CPU ms": 1.0, "iterations": 2.0, **dict.fromkeys(WALL, 9.0)}
    assert without_wall(row) == {"scheme": "async + warp", "CPU ms": 1.0, "iterations": 2.0, **dict.fromkeys(WALL)}
    yardstick = {"scheme": "SciPy", "assemble": 3.0, "solve": 4.0, **dict.fromkeys(WALL[2:])}
    assert without_wall(yardstick) == yardstick, "its stages are times of its thread"
