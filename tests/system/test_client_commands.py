# SPDX-License-Identifier: MIT
"""What a real server makes of its clients' commands: named points, answers, others' names, long pushes."""

import json
import queue
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from clients.client import Client
from clients.errors import BadInput, ClientError
from protocol import messages_pb2 as pb
from protocol.channels import PROTOCOL, key
from protocol.network.session import open_session
from protocol.push_limits import ORPHANED_PUSH
from tests.system.link_helpers import PATIENCE
from tests.system.server_process import Stage, beam, fresh, run, until
from tests.system.test_server import logged

pytestmark = pytest.mark.system

QUIET = 'update = "never"'  # no worker is needed


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    found = Stage(tmp_path)
    yield found
    found.close()


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stage]:
    """A server for tests that leave it as it is."""
    folder = tmp_path_factory.mktemp("server")
    found = Stage(folder)
    found.server(beam(folder, solver=QUIET))
    with found.client() as client:
        until(lambda: client.status().step > 5, "it runs")
    yield found
    found.close()


def sim_client(stage: Stage, *arguments: str) -> "subprocess.CompletedProcess[str]":
    result = run("clients", *arguments, WARPFACTOR_CONNECT=stage.endpoint)
    assert "Traceback" not in result.stderr, result.stderr
    return result


def test_push_and_grab_need_no_coordinates(running: Stage) -> None:
    pushed = sim_client(running, "push", "--object", "beam", "--force", "500", "0", "0")
    assert pushed.returncode == 0, pushed.stderr
    assert re.fullmatch(r"pushed 1 node of beam at \(.*\) for 0\.1 s\n", pushed.stdout)
    held = sim_client(running, "grab", "--object", "beam", "--at", "top", "--to", "0", "1", "3", "--duration", "0.2")
    assert held.returncode == 0 and "holding 1 node of beam at (" in held.stdout, held.stderr


def test_status_and_who_misses_are_told_where_the_body_is(running: Stage) -> None:
    with running.client() as client:
        found = client.status(fresh=True).objects[0]
        assert found.low.x < found.high.x and found.low.z == 0 < found.tip.z <= found.high.z
        with pytest.raises(BadInput, match=r"the nearest is \d.* m away at \(.*\); 'beam' now fills x from .* to .* m"):
            client.push("beam", at=(50, 0, 0), force=(1, 0, 0), radius=0.5)
        with pytest.raises(BadInput, match="no point 'nose'; known: tip"):
            client.push("beam", at="nose", force=(1, 0, 0))
        for wrong in (1e308, 1e200):
            with pytest.raises(BadInput, match=r"target .* 1000 times the size of 'beam'"):
                client.grab("beam", at="tip", target=(wrong, 0, 0), stiffness=1e308)
        assert client.status(fresh=True).objects[0].last.status == pb.CONVERGED
    shown = sim_client(running, "status").stdout
    assert "tip" in shown and re.search(r"beam\s+-?\d\S* … -?\d", shown), shown


def test_another_cannot_act_in_the_name_of_a_client(running: Stage) -> None:
    """Its name and the id of its grab are known to all who read the status; its secret is not."""
    with running.client() as client, open_session("client", connect=[running.endpoint], shared_memory=False) as session:
        held = client.grab("beam", at="tip", stiffness=1e4, max_force=10)
        assert client.id in fresh(client).clients
        ids = pb.Interaction(id=held.interaction.id, object="beam", kind="grab", client=client.id)
        before = client.status().refused

        def forge(verb: str, secret: bytes) -> str:
            command = pb.Command(header=pb.Header(protocol=PROTOCOL), client=client.id, verb=verb, secret=secret,
                                 interaction=ids)  # fmt: skip
            replies = session.zenoh.get(
                key("command", verb=verb, client=client.id), payload=command.SerializeToString(), timeout=30.0
            )
            return next(pb.Reply.FromString(bytes(r.ok.payload)).error for r in replies if r.ok is not None)

        for verb in ("move", "release"):
            for secret in (b"", bytes(16)):
                assert f"Command.secret does not belong to client '{client.id}'" in forge(verb, secret)
        for _ in range(300):
            forge("push", b"")  # its rate is not used up
        assert client.push("beam", at="tip", force=(1, 0, 0), duration=0.02).nodes == 1
        assert fresh(client).refused >= before + 304
        held.move((0.5, 0.5, 4.0))  # it is still there
        held.release()
        assert forge("release", client.secret) == f"client '{client.id}' has no interaction {ids.id}; it may be over"


def test_pause_resume_and_stop_answer(stage: Stage, tmp_path: Path) -> None:
    server = stage.server(beam(tmp_path, solver=QUIET))
    with stage.client() as client:
        until(lambda: client.status().step > 5, "it runs")
        assert client.resume().unchanged
        paused = client.pause()
        assert not paused.unchanged and fresh(client).step == paused.status.step, "it stands still"
        step = paused.status.step
    again = sim_client(stage, "pause")
    assert again.stdout == f"already paused, at step {step} (t = {0.02 * step:.3f} s)\n"
    assert sim_client(stage, "resume").stdout == f"goes on from step {step} (t = {0.02 * step:.3f} s)\n"
    found = json.loads(sim_client(stage, "pause", "--json").stdout)
    assert found["state"] == "paused" and found["changed"] and found["step"] > step
    stopped = sim_client(stage, "stop").stdout
    assert stopped == f"stopped after {found['step']} steps (t = {found['time']:.3f} s)\n"
    assert server.wait() == 0 and f"{found['step']} steps; last" in server.output()


@pytest.mark.parametrize("pace", ["--realtime", "--free-run"])
def test_a_pause_is_answered_when_the_loop_stands_still(stage: Stage, tmp_path: Path, pace: str) -> None:
    server = stage.server(beam(tmp_path, (2, 2, 6), QUIET), pace)
    with stage.client() as client:
        for _ in range(5):
            step = client.pause().status.step
            assert fresh(client).step == step
            client.resume()
            until(lambda step=step: fresh(client).step > step, "it goes on")  # type: ignore[misc]
        steps = client.stop().status.step
    assert server.wait() == 0 and f"{steps} steps; last" in server.output()


@pytest.mark.parametrize(
    ("pace", "update"), [("--realtime", "async"), ("--free-run", "async"), ("--free-run", "every-2")]
)
def test_a_paused_server_makes_single_steps(stage: Stage, tmp_path: Path, pace: str, update: str) -> None:
    stage.server(beam(tmp_path, (2, 2, 6), f'update = "{update}"'), pace)
    with stage.client() as client:
        with pytest.raises(BadInput, match="step: the server is not paused"):
            client.step()
        step = client.pause().status.step
        for n in (1, 1, 7):
            reply = client.step(n)
            step += n
            assert (reply.status.step, reply.status.state) == (step, "paused")
            assert fresh(client).step == step, "it stands still"
        said = sim_client(stage, "step", "2").stdout
        assert said == f"paused at step {step + 2} (t = {0.02 * (step + 2):.3f} s)\n"
        client.resume()
        until(lambda: fresh(client).step > step + 2, "it goes on")


def test_pushes_of_one_who_left_make_room_and_replay_to_the_bit(stage: Stage, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    scene = beam(tmp_path, (2, 2, 6), 'update = "never"')
    scene.write_text(scene.read_text().replace("[solver]", "[record]\nevery = 20\n[solver]"))
    server = stage.server(scene, "--free-run", "--record", str(log))
    with stage.client() as client:
        with pytest.raises(BadInput, match="a push lasts at most 3600 s"):
            client.push("beam", at="tip", force=(1e-9, 0, 0), duration=1e308)
        with Client(connect=[stage.endpoint], timeout=30.0) as leaving:
            for k in range(16):
                leaving.push("beam", at="tip", force=(k, 0, 0), duration=3600)
            with pytest.raises(BadInput, match="has 16 interactions already"):
                client.push("beam", at="tip", force=(1, 0, 0), duration=0.1)
        until(lambda: leaving.id not in fresh(client).clients, "it is gone")
        gone = fresh(client).time
        until(lambda: client.status().time > gone + ORPHANED_PUSH + 1, "what it left is over")
        client.push("beam", at="tip", force=(1, 0, 0), duration=0.1)
        until(lambda: client.status().time > gone + ORPHANED_PUSH + 3, "it goes on")
        client.stop()
    assert server.wait() == 0, server.output()
    last = max(s.time for s in logged(log, "/step/beam") if any(i.client == leaving.id for i in s.interactions))
    assert last < gone + ORPHANED_PUSH + 0.1
    replayed = run("clients", "replay", str(log), "--simulate", "--json", timeout=100)
    assert replayed.returncode == 0, replayed.stdout + replayed.stderr


def test_a_push_of_the_command_line_lasts_as_long_as_it_says(stage: Stage, tmp_path: Path) -> None:
    """A short one without its command; a long one keeps the command, since it would not outlive it for so long."""
    log = tmp_path / "run.mcap"
    scene = beam(tmp_path, (2, 2, 6), QUIET)
    scene.write_text(scene.read_text().replace("[solver]", "[record]\nevery = 20\n[solver]"))
    server = stage.server(scene, "--free-run", "--record", str(log))
    push = ("push", "--object", "beam", "--force", "50", "0", "0", "--duration")
    with stage.client() as client:
        assert sim_client(stage, *push, "0.4").returncode == 0
        long = sim_client(stage, *push, "20")
        assert long.returncode == 0 and long.stdout.endswith("for 20 s; Ctrl-C ends it\ndone\n"), long.stderr
        client.stop()
    assert server.wait() == 0
    steps: dict[int, int] = {}
    for step in logged(log, "/step/beam"):
        for interaction in step.interactions:
            steps[interaction.id] = steps.get(interaction.id, 0) + 1
    assert steps == {1: 20, 2: 1000}


def test_a_client_goes_on_with_a_server_that_was_started_again(stage: Stage, tmp_path: Path) -> None:
    scene = beam(tmp_path, (2, 2, 6), QUIET)
    first = stage.server(scene)
    with stage.client() as client:
        lives = {client.status().header.incarnation}
        first.kill()
        stage.server(scene)

        def answered() -> bool:
            client.timeout = 1.0
            try:
                lives.add(client.status().header.incarnation)
            except ClientError:
                return False
            return len(lives) == 2

        until(answered, "the new server answers")
        client.timeout = PATIENCE
        assert client.push("beam", at="tip", force=(1, 0, 0)).nodes == 1
        told: queue.SimpleQueue[pb.Reply | None] = queue.SimpleQueue()
        client.send("pause", answered=told.put)
        reply = told.get(timeout=PATIENCE)
        assert reply is not None and reply.status.state == "paused"


@pytest.mark.parametrize(
    ("endpoint", "cause"),
    [
        ("tcp/no-such-host.invalid:7447", "the name 'no-such-host.invalid' does not resolve"),
        ("tls/127.0.0.1:0", "Missing TLS private key"),
        ("tcp/203.0.113.5:7999", "Cannot assign requested address"),
    ],
)
def test_why_it_cannot_listen(tmp_path: Path, endpoint: str, cause: str) -> None:
    result = run(
        "sim_server", str(beam(tmp_path, (2, 2, 6), QUIET)), "--steps", "2", "--listen", endpoint, "--insecure"
    )
    assert result.returncode == 2 and cause in result.stderr and "another sim-server" not in result.stderr


def test_a_port_in_use_is_another_server(running: Stage) -> None:
    result = run("sim_server", str(running.folder / "beam.toml"), "--steps", "2", "--listen", running.endpoint)
    assert result.returncode == 2 and "in use" in result.stderr and "is another sim-server there?" in result.stderr
