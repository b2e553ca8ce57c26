# SPDX-License-Identifier: MIT
"""A service that is told to end while it starts, or in a round, ends with its loop, and its log is whole."""

import signal
import threading
from pathlib import Path
from typing import Any

import pytest

from protocol.process.command_line import Terminated, end_in_order, held_signals
from sim_server.network.link import ServerLink
from sim_server.recording.recorder import Recorder
from sim_server.replay.log import Recording
from sim_server.service.service import Service
from sim_server.simulation import Simulation
from tests.ports import free_endpoint
from tests.system.server_process import beam

pytestmark = pytest.mark.system


def test_a_signal_while_the_loop_starts_ends_the_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    start = threading.Thread.start

    def interrupted(thread: threading.Thread) -> None:
        start(thread)
        if thread.name == "loop":
            raise KeyboardInterrupt

    with ServerLink(listen=[free_endpoint()]) as link:
        service = Service(Simulation.load(beam(tmp_path)), link)
        monkeypatch.setattr(threading.Thread, "start", interrupted)
        with pytest.raises(KeyboardInterrupt):
            service.run()
        assert not [thread for thread in threading.enumerate() if thread.name == "loop"], "it runs on"


def test_a_signal_once_records_are_taken_loses_none_of_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told = list[int]()
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    with ServerLink(listen=[free_endpoint()]) as link, Recorder(tmp_path / "run.mcap") as recorder:
        service = Service(Simulation.load(beam(tmp_path, (1, 1, 2))), link, recorder, realtime=False)
        pump = service.driver.pump

        def pumped() -> Any:
            records = pump()
            if len(records) and not told:
                told.append(int(records["step"][-1]))
                signal.raise_signal(signal.SIGTERM)
            return records

        monkeypatch.setattr(service.driver, "pump", pumped)
        end_in_order()
        try:
            with pytest.raises(Terminated), held_signals() as is_told_to_end:
                service.run(is_told_to_end)
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
    with Recording(tmp_path / "run.mcap") as recording:
        assert recording.steps == service.engine.step >= told[0] > 0 and not recording.notes
