# SPDX-License-Identifier: MIT
"""Logs and checkpoints of earlier versions mean what they meant: a bar was split as "kuhn", elements were linear."""

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocol.log_chunks import BadLog
from sim_server.mesh import bar
from sim_server.replay.log import Recording
from sim_server.replay.run import Replay
from sim_server.scene import earlier_defaults
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.ports import free_endpoint
from tests.system.server_process import run

CELLS, SIZE = [3, 2, 2], [1.5, 1.0, 1.0]


def earlier() -> dict[str, Any]:
    """A scene as a log of an earlier version has it: all defaults are written out, but for keys without a value."""
    table = {
        "name": "test", "dt": 0.02, "effects": {"gravity": {"g": [0, -9.81, 0]}},
        "object": [
            {"name": name, "mesh": {"bar": CELLS, "size": SIZE} | split, "pose": {"translate": [0, 0, 3 * k]},
             "effects": {"corotational": {"young": 1e5, "poisson": 0.4}, "fixed": {"where": "X < 0.01"}}}
            for k, (name, split) in enumerate({"said": {"split": "mirrored"}, "unsaid": {}}.items())
        ],
    }  # fmt: skip
    resolved = Scene.model_validate(table).resolved()
    del resolved["object"][1]["mesh"]["split"], resolved["object"][1]["elements"]
    return resolved


def meshes(table: dict[str, Any]) -> list[Any]:
    return [o.load_mesh().tets for o in Scene.model_validate(table).objects]


def test_a_scene_of_an_earlier_version_has_the_split_of_its_default() -> None:
    table = earlier()
    before = copy.deepcopy(table)
    said, unsaid = meshes(earlier_defaults.named(table))
    assert table == before
    np.testing.assert_array_equal(said, bar(CELLS, SIZE, "mirrored").tets)
    np.testing.assert_array_equal(unsaid, bar(CELLS, SIZE, "kuhn").tets)
    np.testing.assert_array_equal(meshes(table)[1], said)  # a scene file of today, without the key


def test_a_scene_of_an_earlier_version_has_linear_elements() -> None:
    def kinds(table: dict[str, Any]) -> list[str]:
        return [body.elements for body in Simulation(Scene.model_validate(table)).world.bodies]

    assert kinds(earlier()) == ["smoothed", "smoothed"] and kinds(earlier_defaults.named(earlier())) == [
        "smoothed",
        "linear",
    ]


def test_a_resolved_scene_names_the_split_of_every_bar() -> None:
    table = Scene.model_validate(earlier()).resolved()
    assert [o["mesh"]["split"] for o in table["object"]] == ["mirrored", "mirrored"]
    assert earlier_defaults.named(table) == table


@pytest.mark.parametrize("odd", [None, 3, [], {}, {"object": 3}, {"object": [3, {}, {"mesh": 3}]}, {"object": {}}])
def test_what_is_no_scene_is_left_to_the_validation(odd: Any) -> None:
    assert earlier_defaults.named(odd) == odd


def test_a_log_of_an_earlier_version_is_repeated_with_the_split_of_its_default(tmp_path: Path) -> None:
    scene, log = tmp_path / "beam.toml", tmp_path / "run.mcap"
    scene.write_text(
        'dt = 0.02\n[solver]\npreconditioner = "block_jacobi"\n[[object]]\nname = "a"\n'
        f'mesh = {{ bar = {CELLS}, size = {SIZE}, split = "kuhn" }}\n'
        '[object.effects]\ncorotational = { young = 1e5, poisson = 0.4 }\nfixed = { where = "X < 0.01" }\n'
    )
    end = ("--free-run", "--steps", "4", "--listen", free_endpoint(), "--device", "cpu")
    done = run("sim_server", str(scene), "--record", str(log), *end)
    assert done.returncode == 0, done.stderr
    with Recording(log) as recording:
        table = json.loads(recording.scene.resolved)
        del table["object"][0]["mesh"]["split"]
        recording.scene.resolved = json.dumps(table)
        found = Replay(recording).run()
        assert found.same and found.solves_compared == 4, found.lines()
        table["object"][0]["mesh"]["split"] = "mirrored"
        recording.scene.resolved = json.dumps(table)
        with pytest.raises(BadLog):
            Replay(recording)
