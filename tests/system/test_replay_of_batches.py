# SPDX-License-Identifier: MIT
"""A run whose factors come several in a message is repeated from its log to the bit."""

from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from protocol import messages_pb2 as pb
from protocol.channels import key
from protocol.network.session import open_session
from protocol.shared_memory.limits import obstacle
from tests.system.server_process import Stage, fresh, until
from tests.system.test_replay_of_a_server import CPU, messages, replayed

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(bool(obstacle()), reason=f"no shared memory here: {obstacle()}"),
]

BARS, STEPS = 12, 60
SCENE = """
dt = 0.02
[effects]
gravity = { g = [0, -9.81, 0] }
[solver]
preconditioner = "cholesky"
"""
BAR = """
[[object]]
name = "bar{k}"
mesh = {{ bar = [1, 1, {length}], size = [1, 1, {length}], split = "kuhn" }}
pose = {{ translate = [{x}, 0, 0] }}
[object.effects]
corotational = {{ young = 1e6, poisson = 0.4 }}
fixed = {{ where = "Z < 0.01" }}
"""


def test_the_same_bit_for_bit(tmp_path: Path) -> None:
    stage, log, scene = Stage(tmp_path), tmp_path / "run.mcap", tmp_path / "bars.toml"
    scene.write_text(SCENE + "".join(BAR.format(k=k, x=3 * k, length=3 + k % 3) for k in range(BARS)))
    sizes: Counter[int] = Counter()  # of messages with factors

    def count(sample: Any) -> None:
        sizes[len(pb.FactorBatch.FromString(bytes(sample.attachment)).jobs)] += 1

    try:
        server = stage.server(scene, "--record", str(log), "--workers", "1", *CPU)
        with stage.client() as client:
            session = open_session("client", connect=[stage.endpoint])
            listening = session.zenoh.declare_subscriber(key("factors"), count)
            came = lambda: sum(size * times for size, times in sizes.items() if size > 1)  # noqa: E731
            until(lambda: came() > 3 * BARS and fresh(client).step >= STEPS, "factors in batches")
            client.stop()
            listening.undeclare()
            session.close()
        assert server.wait() == 0, server.output()
    finally:
        stage.close()
    assert len({f.header.object for f in messages(log, "factor")}) == BARS
    found = replayed(log, 0)
    assert found["same"] and found["first"] is None and found["other_factor"] is None and not found["notes"]
    assert found["steps"] >= STEPS and found["solves"] == BARS * found["steps"]
