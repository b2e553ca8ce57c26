# SPDX-License-Identifier: MIT
"""sim-client load: scenes drawn from a seed, a short run of our own, one on a server that runs already, Ctrl-C."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clients.errors import BadInput, ClientError
from clients.load_test import scene
from clients.load_test.options import LoadOptions, span
from clients.load_test.run import free_end, plan
from clients.log.frames import Mesh
from protocol import messages_pb2 as pb
from tests.scenes import scene as sample

ROOT = Path(__file__).parents[2]
ASKED: dict[str, Any] = {
    "objects": 2, "tets": (24, 48), "clients": 2, "rate": 20.0, "seconds": 1.0, "workers": 1, "seed": 1,
    "device": "cpu", "out": None, "connect": None, "server": "sim",
}  # fmt: skip


def test_the_same_seed_gives_the_same_scene_and_another_another() -> None:
    one = scene.scene_text(20, (200, 3000), 7)
    assert one == scene.scene_text(20, (200, 3000), 7) != scene.scene_text(20, (200, 3000), 8)
    assert one.isascii(), "the same bytes in every encoding"


def test_bodies_have_the_sizes_asked_for_and_names_of_their_own() -> None:
    table = tomllib.loads(scene.scene_text(60, (200, 3000), 3))
    bars = [found["mesh"]["bar"] for found in table["object"]]
    tets = [6 * a * b * c for a, b, c in bars]
    assert len({found["name"] for found in table["object"]}) == 60
    assert 150 <= min(tets) < 400 and 2000 < max(tets) <= 3300, "a bar has whole cells: about, not exactly"
    young = [found["effects"]["corotational"]["young"] for found in table["object"]]
    assert min(young) >= 1e6 and max(young) <= 1e7 and len(set(young)) > 50
    places = [tuple(found["pose"]["translate"]) for found in table["object"]]
    assert len(set(places)) == 60


@pytest.mark.parametrize("objects", [1, 2, 100])
def test_the_server_reads_such_a_scene(objects: int, tmp_path: Path) -> None:
    from sim_server.scene import load

    path = tmp_path / "load.toml"
    path.write_text(scene.scene_text(objects, (24, 300), 5))
    assert len(load(path).objects) == objects


@pytest.mark.parametrize("tets", [6, 24, 200, 540, 3000, 24_000])
def test_a_bar_of_about_so_many_tetrahedra(tets: int) -> None:
    a, b = scene.cells(tets)
    assert 6 * a * a * b == pytest.approx(tets, rel=0.3)


@pytest.mark.parametrize(("text", "found"), [("200..3000", (200, 3000)), ("540", (540, 540))])
def test_spans(text: str, found: tuple[int, int]) -> None:
    assert span(text) == found


@pytest.mark.parametrize("text", ["", "a..b", "1..", "1-5", "..7"])
def test_bad_spans(text: str) -> None:
    with pytest.raises(BadInput, match=r"--tets .*: allowed is a number, or two as in 200\.\.3000"):
        span(text)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"objects": 0}, "--objects 0: allowed is 1 to 4096"),
        ({"clients": 1000}, "--clients 1000: allowed is 0 to 256"),
        ({"rate": 0.0}, "--rate 0: allowed is 0.1 to 2000"),
        ({"rate": float("nan")}, "--rate nan: allowed is 0.1 to 2000"),
        ({"seconds": -1.0}, "--seconds -1: allowed is 0.5 to 86400"),
        ({"workers": 65}, "--workers 65: allowed is 0 to 64"),
        ({"seed": -1}, "--seed -1: allowed is"),
        ({"tets": (3000, 200)}, r"--tets 3000\.\.200: allowed are two numbers of 6 to 100000, the smaller one first"),
        ({"device": "tpu"}, "--device tpu: allowed are auto, cpu, gpu"),
    ],
)
def test_what_cannot_be_asked_for(change: dict[str, Any], said: str) -> None:
    with pytest.raises(BadInput, match=said):
        LoadOptions(**(ASKED | change))


def mesh(name: str) -> Mesh:
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [0, 0, 4]])
    none = np.zeros((0, 4), np.int32)
    return Mesh(name, 1, rest, none, none, np.array([0, 1], np.int32), np.zeros(0), np.zeros(0))


def test_clients_take_turns_on_the_bodies_that_may_be_touched() -> None:
    bodies = [{"name": n, "mesh": {"bar": [1, 1, 1], "size": [1, 1, 1]}} for n in ("a", "b", "c")]
    for body in bodies[:2]:
        body["effects"] = {"touch": {"max_force": 7.0}}
    scene = pb.Scene(resolved=json.dumps(sample(*bodies).resolved()))
    meshes = {name: mesh(name) for name in ("a", "b", "c")}
    plans = plan(scene, meshes, 8, 50.0, 3)
    assert [p["object"] for p in plans] == ["a", "b"] * 4
    for name in ("a", "b"):
        assert {p["grabs"] for p in plans if p["object"] == name} == {True, False}, "each is pushed and grabbed"
    assert {p["force"] for p in plans} == {7.0} and plans[0]["at"] == [0, 0, 4] == free_end(mesh("a"))
    assert plans == plan(scene, meshes, 8, 50.0, 3) != plan(scene, meshes, 8, 50.0, 4)
    untouchable = pb.Scene(resolved=json.dumps(sample(bodies[2]).resolved()))
    with pytest.raises(ClientError, match="no object of this server lists the effect touch"):
        plan(untouchable, meshes, 1, 50.0, 3)
    assert plan(untouchable, meshes, 0, 50.0, 3) == []


def start(*arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "clients", "load", *arguments]
    environment = os.environ | {"COLUMNS": "120"}
    return subprocess.Popen(
        command, cwd=ROOT, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )


def run(*arguments: str) -> tuple[int, str, str]:
    process = start(*arguments)
    out, err = process.communicate(timeout=100)
    return process.returncode, out, err


TINY = (
    "--objects",
    "2",
    "--tets",
    "24..96",
    "--clients",
    "4",
    "--rate",
    "40",
    "--seconds",
    "2",
    "--quiet",
    "1",
    "--workers",
    "1",
)


@pytest.mark.system
def test_a_short_run(tmp_path: Path) -> None:
    code, out, err = run(*TINY, "--json", "--out", str(tmp_path))
    assert code == 0, err
    found = json.loads(out)
    assert "keep" in found["verdict"] and "steps late" in found["verdict"]
    assert found == json.loads((tmp_path / "load.json").read_text())
    assert (tmp_path / "load.toml").read_text() == scene.scene_text(2, (24, 96), 1)
    assert (tmp_path / "load.png").read_bytes().startswith(b"\x89PNG") and (tmp_path / "load.mcap").stat().st_size
    steps, commands = found["steps"], found["clients"]["commands"]
    assert steps["count"] > 10 and 0 < steps["ms_p50"] <= steps["ms_p99"] <= steps["ms_max"]
    assert len(steps["ms"]) == steps["count"], "every step is in the log"
    quiet = steps["quiet"]
    assert quiet["count"] > 10 and 0 < quiet["ms_p50"] <= quiet["ms_p99"] <= quiet["ms_max"]
    assert quiet["ratio"]["ms_p50"] == pytest.approx(steps["ms_p50"] / quiet["ms_p50"])
    assert [body["steps"] for body in found["objects"]] == [steps["count"]] * 2
    assert all(body["iterations_mean"] > 0 and body["unconverged"] == 0 for body in found["objects"])
    assert commands["sent"] > 40 and commands["done"] > 0 and commands["unanswered"] == 0
    assert commands["sent"] == commands["done"] + commands["refused"]
    assert len(found["clients"]["each"]) == 4 and {c["kind"] for c in found["clients"]["each"]} == {"push", "grab"}
    workers = found["workers"]
    assert workers["count"] == 1 and workers["factors"] > 0 and workers["bytes_out"] > 0 and workers["bytes_in"] > 0


@pytest.mark.system
def test_on_a_server_that_runs_already(tmp_path: Path) -> None:
    from tests.system.server_process import Stage, beam, until

    stage = Stage(tmp_path)
    try:
        stage.server(beam(tmp_path))
        with stage.client() as client:
            until(lambda: client.status().step > 5, "it runs")
            code, out, err = run("--connect", stage.endpoint, "--clients", "3", "--rate", "40", "--seconds", "1.5")
            assert code == 0, err
            assert re.match(r"(keeps pace: .* steps late|does not keep pace: .* s simulated a second, )", out), out
            assert "beam on cpu" in out and "3 clients" in out and "0 unanswered" in out
            assert client.status().state == "running", "it is left as it was"
            until(lambda: len(client.status().clients) == 1, "its clients have gone")
    finally:
        stage.close()


@pytest.mark.system
def test_ctrl_c_leaves_nothing_behind(tmp_path: Path) -> None:
    process = start(*TINY[:-4], "--seconds", "600", "--workers", "1", "--out", str(tmp_path))
    log = tmp_path / "load.mcap"
    deadline = time.monotonic() + 60
    while not (log.exists() and log.stat().st_size > 30_000) and time.monotonic() < deadline:
        time.sleep(0.05)
    time.sleep(1)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in err
    said = (tmp_path / "load.txt").read_text()
    assert "steps; last" in said, f"the server ended in good order: {said}"
    left = [path for path in Path("/proc").glob("[0-9]*/cmdline") if str(log).encode() in _read(path)]
    assert not left


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


@pytest.mark.system
@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (("--tets", "5..x"), 2, "--tets 5..x: allowed is a number, or two as in 200..3000"),
        (("--objects", "0"), 2, "--objects 0: allowed is 1 to 4096"),
        (("--connect", "tcp/127.0.0.1:9"), 1, "no server 'sim' at tcp/127.0.0.1:9"),
        (("--out", "pyproject.toml/x"), 2, "--out pyproject.toml/x: cannot be made: Not a directory"),
    ],
)
def test_errors(arguments: tuple[str, ...], code: int, said: str) -> None:
    found, _, err = run(*arguments)
    assert found == code and said in err and "Traceback" not in err


def test_help_has_examples() -> None:
    code, out, _ = run("--help")
    assert code == 0 and "Examples:\n    sim-client load" in out
