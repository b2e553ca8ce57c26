# SPDX-License-Identifier: MIT
"""`sim-client replay`: publishes a log, or simulates it again."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from clients.errors import BadInput
from clients.progress import progress_bar
from clients.replay.player import Player, speed_of
from clients.replay.replay_server import ReplayServer
from clients.replay.timeline import Timeline
from protocol.channels import SERVER_NAME
from protocol.log_pieces import size_of_log
from protocol.printable import printable
from protocol.process.own_python import own_module


def republish(
    log: Path, speed: str, loop: bool, begin: float, end: float | None, name: str | None,
    connect: Sequence[str] | None, listen: Sequence[str] | None, as_json: bool, insecure: bool = False,
    tls: str | None = None,
) -> None:  # fmt: skip
    """Publishes the log under the name of a server; prints what it does (as_json: a summary at the end, as JSON)."""
    rate = speed_of(speed)
    last = math.inf if end is None else end
    if not 0 <= begin <= last or math.isnan(last):
        raise BadInput(f"--from {begin:g} --to {last:g}: allowed are 0 <= from <= to, s of simulation")
    with progress_bar("reading", size_of_log(log)) as progress:
        timeline = Timeline(log, progress)
    with timeline:
        for note in timeline.notes:
            print(f"sim-client: {printable(note)}", file=sys.stderr)
        with ReplayServer(name, timeline.scene.server or SERVER_NAME, connect, listen, insecure, tls) as server:
            replay = Player(timeline, server, rate, begin, last)
            if not as_json:
                print(
                    f"replaying {log.name}, {begin:g} to {replay.end:g} s, as server {server.name!r} "
                    f"at {server.where}; Ctrl-C ends",
                    flush=True,
                )
            replay.play(loop)
        if timeline.malformed:
            print(f"sim-client: {log}: {timeline.malformed} malformed messages left out", file=sys.stderr)
        sent = {"server": server.name, "states": replay.states, "steps": replay.steps}
        print(json.dumps(sent) if as_json else f"sent {replay.states} states and {replay.steps} steps")


def simulate(log: Path, as_json: bool) -> int:
    """Runs the log again in a process of the server's program; returns its exit code: 0 same, 1 diverged, 2 bad log."""
    command = own_module("sim_server.replay", str(log), *(["--json"] if as_json else []))
    process = subprocess.Popen(command)
    try:
        return process.wait()
    finally:
        if process.poll() is None:  # Ctrl-C reaches it too; anything else must be passed on
            process.terminate()
            process.wait()
