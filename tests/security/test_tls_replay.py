# SPDX-License-Identifier: MIT
"""A replay with the certificate of a server: clients have the rights of their roles, and others none."""

import contextlib
from pathlib import Path

import pytest

from clients.client import Client
from clients.errors import BadInput, ClientError
from tests.sample_run import record
from tests.system.server_process import PATIENCE, Stage, run, until

pytestmark = pytest.mark.system


def test_roles_count_in_a_replay(tmp_path: Path) -> None:
    certs = tmp_path / "certs"
    made = run("sim_server", "certs", str(certs), "--host", "localhost", "--client", "bob:operator")
    assert made.returncode == 0, made.stderr
    log = record(tmp_path / "run.mcap", 500)
    refused = run("clients", "replay", str(log), "--tls", str(certs / "viewer"))
    assert refused.returncode == 2 and "this certificate is that of a viewer; a replay shows that of a server" in (
        refused.stderr
    )
    stage = Stage(tmp_path)
    endpoint = stage.endpoint.replace("tcp/", "tls/")
    try:
        stage.start("clients", "replay", str(log), "--loop", "--tls", str(certs), "--listen",
                    endpoint.replace("127.0.0.1", "0.0.0.0"))  # fmt: skip

        found: list[Client] = []

        def there() -> bool:
            with contextlib.suppress(ClientError):
                found.append(Client(connect=[endpoint], tls=certs / "viewer", timeout=2.0))
            return bool(found)

        until(there, "the replay is there")
        viewer, bob = found[0], Client(connect=[endpoint], tls=certs / "bob", timeout=PATIENCE)
        viewer.timeout = PATIENCE
        with viewer, bob:
            assert viewer.status().scene and list(viewer.meshes()) == ["beam"]
            states = viewer.states()
            until(states.newest, "a state")
            with pytest.raises(BadInput, match="'viewer' is that of a viewer; pause is for operator"):
                viewer.pause()
            assert bob.pause().status.state == "paused" and bob.pause().unchanged
        with pytest.raises(ClientError, match="it asks for a certificate"):
            Client(connect=[endpoint], timeout=0.5)
    finally:
        stage.close()
