# SPDX-License-Identifier: MIT
"""A service that is told to end while it starts ends, with its loop."""

import threading
from pathlib import Path

import pytest

from sim_server.network.link import ServerLink
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
