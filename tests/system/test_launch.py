# SPDX-License-Identifier: MIT
"""deploy/launch.py: objects distributed by size, and real servers with a worker that they share."""

import importlib.util
import json
import os
import signal
import subprocess
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from clients.client import Client
from clients.errors import ClientError
from sim_server.scene import load
from tests.ports import free_endpoint
from tests.system.link_helpers import PATIENCE, ROOT
from tests.system.server_process import alive, until

LAUNCH = ROOT / "deploy" / "launch.py"
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
mesh = {{ bar = [{cells}, 2, 4], size = [1, 1, 2] }}
[object.effects]
corotational = {{ young = [{{ where = "Z < 1", young = 1e6 }}, {{ young = 2e6 }}], poisson = 0.4 }}
fixed = {{ where = "Z < 0.01" }}
"""


def module() -> Any:
    spec = importlib.util.spec_from_file_location("launch", LAUNCH)
    assert spec is not None and spec.loader is not None
    launch = importlib.util.module_from_spec(spec)
    sys.modules["launch"] = launch  # its dataclass looks itself up there
    spec.loader.exec_module(launch)
    return launch


def scene(folder: Path, cells: Sequence[int]) -> Path:
    path = folder / "bars.toml"
    path.write_text(SCENE + "".join(BAR.format(k=k, cells=c) for k, c in enumerate(cells)))
    return path


@pytest.mark.parametrize(
    ("tets", "servers", "expected"),
    [
        ([5], 3, [(0,)]),
        ([1, 1, 1, 1], 2, [(0, 2), (1, 3)]),
        ([10, 1, 2, 3, 4], 2, [(0,), (1, 2, 3, 4)]),
        ([3, 9, 5, 5], 2, [(0, 1), (2, 3)]),
        ([0, 0, 0], 2, [(0, 2), (1,)]),
    ],
)
def test_objects_are_dealt_out_by_size(tets: list[int], servers: int, expected: list[tuple[int, ...]]) -> None:
    parts = module().distribute(tets, servers)
    assert [part.objects for part in parts] == expected
    assert [part.tets for part in parts] == [sum(tets[i] for i in part.objects) for part in parts]


def test_a_part_is_a_scene_with_its_objects_as_they_were(tmp_path: Path) -> None:
    launch = module()
    whole = load(scene(tmp_path, [2, 3, 4]), ["solver.tolerance=1e-8"])
    part = tmp_path / "part.toml"
    part.write_text(launch.part_of(whole, launch.Part((0, 2), 0)))
    assert tomllib.loads(part.read_text())["solver"]["tolerance"] == 1e-8
    objects = load(part).resolved()["object"]
    assert objects == [whole.resolved()["object"][k] for k in (0, 2)]


def test_a_part_keeps_obstacles_and_the_friction_of_its_own_objects(tmp_path: Path) -> None:
    pairs = ", ".join(f'{{ between = ["bar{k}", "floor"], value = 0.{k + 1} }}' for k in range(3))
    given = scene(tmp_path, [2, 3, 4])
    contact = f'gravity = true\ncontact = {{ friction = [{pairs}] }}\n[[obstacle]]\nname = "floor"\nshape = "plane"\n'
    given.write_text(given.read_text().replace("gravity = { g = [0, -9.81, 0] }\n", contact))
    launch, whole, part = module(), load(given), tmp_path / "part.toml"
    part.write_text(launch.part_of(whole, launch.Part((0, 2), 0)))
    resolved = load(part).resolved()
    assert resolved["obstacle"] == whole.resolved()["obstacle"]
    assert [pair["between"][0] for pair in resolved["effects"]["contact"]["friction"]] == ["bar0", "bar2"]


@pytest.mark.parametrize(
    ("visible", "expected"),
    [
        (None, ["0", "1", "2"]), ("2,0", ["2", "0"]), (" GPU-ab , MIG-cd", ["GPU-ab", "MIG-cd"]), ("", []),
        ("1,-1,0", ["1"]),
    ],
)  # fmt: skip
def test_gpus_are_those_that_the_user_lets_be_seen(visible: str | None, expected: list[str], monkeypatch: Any) -> None:
    launch = module()
    monkeypatch.setattr(launch, "installed_gpus", lambda: 3)
    assert launch.usable_gpus({} if visible is None else {"CUDA_VISIBLE_DEVICES": visible}) == expected


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("#!/bin/sh\nprintf 'GPU 0: one (UUID: a)\\n  MIG 1g.10gb Device 0: (UUID: b)\\nGPU 1: two (UUID: c)\\n'\n", 2),
        ("#!/bin/sh\necho 'GPU 0: but failed'; exit 9\n", 0),
        (None, 0),
    ],
    ids=["two", "fails", "is not there"],
)
def test_gpus_are_counted_where_there_are_any(
    text: str | None, expected: int, tmp_path: Path, monkeypatch: Any
) -> None:
    if text is not None:
        (tmp_path / "nvidia-smi").write_text(text)
        (tmp_path / "nvidia-smi").chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert module().installed_gpus() == expected


@pytest.mark.parametrize(
    ("pool", "servers", "workers", "expected"),
    [
        (["0", "1"], 3, 0, (["0", "1", "0"], [])),
        (["3", "5", "7"], 2, 2, (["3", "5"], ["7", "3"])),
        (["0", "1"], 0, 3, ([], ["0", "1", "0"])),
        (["0"], 2, 1, ([None, None], [None])),
        ([], 1, 1, ([None], [None])),
    ],
)
def test_gpus_go_round(pool: list[str], servers: int, workers: int, expected: Any) -> None:
    assert module().distribute_gpus(pool, servers, workers) == expected


def test_each_process_sees_its_gpu_alone(tmp_path: Path, monkeypatch: Any) -> None:
    """Servers and workers, the latter also when they are started again; without a choice nothing is set."""
    launch = module()
    seen: list[tuple[str, str | None]] = []

    def popen(command: Sequence[str], env: dict[str, str] | None = None, **_: Any) -> Any:
        seen.append((command[command.index("--name") + 1], None if env is None else env["CUDA_VISIBLE_DEVICES"]))
        return SimpleNamespace(pid=1, returncode=0, poll=lambda: 0, wait=lambda timeout=None: 0)

    monkeypatch.setattr(launch.subprocess, "Popen", popen)
    whole = load(scene(tmp_path, [2, 2]))
    for pool, expected in (
        (["4", "6", "8"], [("sim-0", "4"), ("sim-1", "6"), ("local-1", "8"), ("local-2", "4"), ("local-2", "4")]),
        (["0"], [("sim-0", None), ("sim-1", None), ("local-1", None), ("local-2", None), ("local-2", None)]),
    ):
        seen.clear()
        with launch.Fleet(whole, launch.distribute([1, 1], 2), "tcp/127.0.0.1", 7447, None, True) as fleet:
            fleet.use_gpus(pool, True, 2)
            fleet.start(2, ["--device", "gpu"], ["--device", "gpu"])
            fleet.workers.start(fleet.workers.workers[1])
            told = fleet.describe()
        assert seen == expected
        assert [(p["name"], p["gpu"]) for p in told["servers"] + told["workers"]] == expected[:4]


@pytest.mark.system
def test_two_servers_and_a_worker_from_one_scene(tmp_path: Path) -> None:
    port = int(free_endpoint().rpartition(":")[2])
    command = [sys.executable, str(LAUNCH), str(scene(tmp_path, [4, 2, 3])), "--servers", "2", "--workers", "1"]
    command += ["--port", str(port), "--record", str(tmp_path / "logs"), "--json"]
    with (tmp_path / "err").open("w") as err:
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=err, text=True)
    assert process.stdout is not None
    started = json.loads(process.stdout.readline())
    assert [s["objects"] for s in started["servers"]] == [["bar0"], ["bar1", "bar2"]]
    pids = [p["pid"] for p in started["servers"] + started["workers"]]
    try:
        for server in started["servers"]:
            until(lambda s=server: used(s) > 1, f"{server['name']} has factors of the worker")
    finally:
        os.kill(process.pid, signal.SIGINT)
        code = process.wait(PATIENCE)
    assert code == 130, (tmp_path / "err").read_text()
    assert not any(map(alive, pids))
    assert sorted(path.name for path in (tmp_path / "logs").iterdir()) == ["sim-0.mcap", "sim-1.mcap"]


def used(server: dict[str, Any]) -> int:
    """Fewest factors that an object of the server used; 0 while it starts."""
    try:
        with Client(server["name"], [server["endpoint"]], timeout=1.0) as client:
            return min(o.factors_used for o in client.status().objects)
    except ClientError:
        return 0


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["nowhere.toml"], "nowhere.toml"),
        ([str(ROOT / "deploy/scenes/beam.toml"), "--set", "nonsense=1"], "nonsense"),
        ([str(ROOT / "deploy/scenes/four_beams.toml"), "--port", "65535"], "PORT 0 to 65535"),
    ],
)
def test_bad_input_is_one_clear_message(arguments: list[str], text: str) -> None:
    done = subprocess.run([sys.executable, str(LAUNCH), *arguments], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2 and text in done.stderr and "Traceback" not in done.stderr
