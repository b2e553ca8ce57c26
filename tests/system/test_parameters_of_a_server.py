# SPDX-License-Identifier: MIT
"""Parameters set on a running server from library and command line, with a worker beside it, and the replay."""

import json
import time
from pathlib import Path

import pytest

from clients.client import Client
from clients.errors import BadInput
from clients.log.reader import Log
from tests.system.link_helpers import endpoint_of
from tests.system.server_process import run, until
from tests.system.test_replay_of_a_server import messages, recorded, replayed

pytestmark = pytest.mark.system
YOUNG = "beam.corotational.young"


def parameters_set(client: Client) -> None:
    """Sets parameters as a slider does, several at once, and twice in a pause."""
    for k in range(20):
        client.set(YOUNG, 1e6 * 1.05**k)
        time.sleep(0.005)
    (young,) = client.set({f"object.{YOUNG}".replace("beam.", "beam.effects."): "2e5"})
    assert young.now.value == "200000.0" and young.unit == "Pa" and young.logarithmic
    client.pause()
    client.set({YOUNG: 3e5, "beam.corotational.poisson": 0.2})
    client.set(YOUNG, 4e5)
    with pytest.raises(BadInput, match=r"beam\.density = 900: cannot change while steps run"):
        client.set({YOUNG: 1e9, "beam.density": "900"})
    with pytest.raises(BadInput, match="0 parameters"):
        client.set({})
    with pytest.raises(BadInput, match="at most"):
        client.set(YOUNG, "1" * 9000)
    now = {p.now.key: p.now.value for p in client.parameters()}
    assert now["object.beam.effects.corotational.young"] == "400000.0"
    assert now["object.beam.effects.corotational.poisson"] == "0.2"
    client.resume()
    time.sleep(0.1)


def by_command_line(client: Client) -> None:
    """The same, and others with sim-client in a pause, in which steps wait for it."""
    parameters_set(client)
    client.pause()
    where = ("--connect", endpoint_of(client))
    said = run("clients", "set", f"{YOUNG}=5e5", "beam.corotational.poisson=0.25", *where)
    assert said.returncode == 0 and "500000.0" in said.stdout and "Pa" in said.stdout, said.stderr
    bad = run("clients", "set", f"{YOUNG}=-1", *where)
    assert bad.returncode == 2 and "must be greater than 0" in bad.stderr
    listed = json.loads(run("clients", "parameters", "--json", *where).stdout)
    assert {"key": "object.beam.effects.corotational.young", "value": "500000.0"} in [p["now"] for p in listed]
    until(lambda: (client.meshes()["beam"].young == 5e5).all(), "who asks for the mesh is told the new modulus")
    client.resume()


def test_what_was_set_is_in_the_log_and_repeated_bit_for_bit(tmp_path: Path) -> None:
    log = recorded(tmp_path, touch=by_command_line)
    found = messages(log, "parameters")
    steps = [m.step for m in found]
    assert len(found) > 5 and steps == sorted(set(steps)), "each with the step at which the loop took it"
    last = {p.key.rpartition(".")[2]: p.value for m in found for p in m.parameters}
    assert last == {"young": "500000.0", "poisson": "0.25"}
    paused = next(m for m in found if len(m.parameters) == 2)
    assert [p.value for p in paused.parameters] == ["400000.0", "0.2"] and paused.client
    with Log(log) as opened:
        assert opened.complete and [m.step for m in opened.parameters] == steps
    assert replayed(log, 0)["same"]
