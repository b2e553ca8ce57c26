# SPDX-License-Identifier: MIT
"""A log of its own for each start of a server."""

from pathlib import Path

import pytest

from protocol import messages_pb2 as pb
from protocol.log_pieces import size_of_log
from sim_server.recording.recorder import Recorder
from sim_server.recording.rotation import Rotation
from sim_server.recording.starts import earlier, started


def test_a_name_has_the_time_of_the_start_in_utc(tmp_path: Path) -> None:
    template = tmp_path / "{time}" / "run-{time}.mcap"
    assert started(template, 0.9) == tmp_path / "{time}" / "run-19700101T000000Z.mcap"
    assert started(tmp_path / "run.mcap", 0.9) == tmp_path / "run.mcap"


def test_earlier_logs_are_found_oldest_first_with_their_pieces(tmp_path: Path) -> None:
    first, second = (started(tmp_path / "a.b-{time}.mcap", t) for t in (0, 86400))
    logs = [first, first.with_suffix(".0002.mcap"), first.with_suffix(".0010.mcap"), second]
    others = ["a.b-now.mcap", "axb-19700101T000000Z.mcap", "a.b-19700101T000000Z.mcap.bak", f"{first.stem}.2.mcap"]
    for path in [*reversed(logs), *(tmp_path / name for name in others)]:
        path.touch()
    assert earlier(tmp_path / "a.b-{time}.mcap") == logs
    assert earlier(tmp_path / "a.b-19700101T000000Z.mcap") == []
    assert earlier(tmp_path / "none" / "{time}.mcap") == []


@pytest.mark.parametrize("keep", ["2MB", "100MB"])
def test_the_budget_counts_the_logs_of_all_starts(tmp_path: Path, keep: str) -> None:
    template = tmp_path / "run-{time}.mcap"
    old = [started(template, t) for t in (0, 60, 120)]
    for path in old:
        path.write_bytes(b"\x89MCAP0\r\n" + bytes(900_000))
    foreign = started(template, 180)
    foreign.write_text("not a log" * 1000)
    rotation = Rotation.of_options(["1MB"], keep)
    with Recorder(
        started(template), rotation=Rotation(rotation.bytes, None, rotation.keep, tuple(earlier(template)))
    ) as r:
        r.scene(pb.Scene(name="s.toml", resolved="{}", dt=0.1, objects=["beam"]))
    # The newest two of 900 kB and what is written fit 2 MB.
    assert [path.exists() for path in old] == ([False, True, True] if keep == "2MB" else [True, True, True])
    assert foreign.exists() and size_of_log(r.path) > 0
