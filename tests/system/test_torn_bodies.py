# SPDX-License-Identifier: MIT
"""A beam that tears by itself when it is pulled too far, and the replay of its log."""

from pathlib import Path

import pytest

from clients.client import Client
from clients.log.reader import Log
from tests.system.server_process import until
from tests.system.test_replay_of_a_server import recorded, replayed

pytestmark = pytest.mark.system
TETS = 3 * 3 * 10 * 6


def watched(client: Client) -> None:
    """Its own weight is too much for its root; then it is told to hold."""
    until(lambda: len(client.meshes()["beam"].tets) < TETS, "it tears")
    client.set("beam.cutting.tear", 50.0)
    left = len(client.meshes()["beam"].tets)
    assert left > 0


def test_a_body_that_is_stretched_too_far_tears(tmp_path: Path) -> None:
    log = recorded(tmp_path, touch=watched, effects="cutting = { tear = 1.15 }\n")
    with Log(log) as opened:
        assert any(p.key.endswith("cutting.removed") for m in opened.parameters for p in m.parameters)
    assert replayed(log, 0)["same"]
