# SPDX-License-Identifier: MIT
"""What the status says of records that nobody got, and how the client shows it."""

import io
from types import SimpleNamespace

from rich.console import Console

from clients.watch import tables
from protocol import messages_pb2 as pb
from sim_server.driver import Driver
from sim_server.telemetry import Telemetry
from tests.scenes import bar, simulation


def status(recorder: SimpleNamespace | None) -> pb.Status:
    """Of a run whose loop and log have lost something."""
    sim, found = simulation(bar(young=1e5), gravity=(0, -9.81, 0)), []
    link = SimpleNamespace(publish_status=found.append)
    telemetry = Telemetry(Driver(sim), link, recorder, patient=False)  # type: ignore[arg-type]
    sim.engine.loop.records_dropped, sim.engine.loop.frames_dropped = 5, 2
    telemetry.publish_status("running")
    return found[0]


def test_the_status_counts_what_the_loop_dropped_and_what_the_log_lost():
    found = status(SimpleNamespace(dropped=3, lost=7))
    assert (found.records_dropped, found.records_lost, found.frames_dropped) == (5, 7, 2 + 3)
    assert status(None).records_lost == 0


def test_the_client_shows_these_numbers():
    text = io.StringIO()
    Console(width=200, file=text).print(tables(pb.Status(frames_dropped=4, records_dropped=51, records_lost=62)))
    assert "dropped: frames 4, step records 51; lost to the log 62" in text.getvalue()
