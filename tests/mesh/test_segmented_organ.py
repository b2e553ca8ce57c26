# SPDX-License-Identifier: MIT
"""The segmented organ of docs/scenes.md: the ten lines there, and the files that tests/support/organ.py makes."""

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from sim_server.mesh import fill
from sim_server.scene import load
from sim_server.simulation import Simulation
from tests.support.organ import TUMOUR, organ, write

PAGE = Path(__file__).parents[2] / "docs" / "scenes.md"
LINES = PAGE.read_text().split("<!-- organ -->\n```toml\n")[1].split("```")[0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("organ")
    write(made)
    (made / "organ.toml").write_text(LINES)
    return made


def test_ten_lines_make_a_scene_of_it(folder):
    """The tumour is stiff, the ligament holds, and the organ sags to where its weight is held."""
    assert len(LINES.splitlines()) == 10
    mesh, tumour, ligament = organ()
    scene = load(folder / "organ.toml")
    sim = Simulation(scene)
    body = sim.world.bodies[0]
    np.testing.assert_allclose(body.mesh.volumes.sum(), mesh.volumes.sum(), rtol=1e-9)
    inside = TUMOUR.distances(body.centroids) < 0
    assert inside.sum() == tumour.sum() > 20
    young = next(e.elastic[0][0] for e in sim.effects.values() if e.elastic)
    assert np.array_equal(young, np.where(inside, 5e4, 5e3))
    held = sim.world.free == 0
    assert held.sum() == len(np.unique(ligament)) > 5 and body.mesh.rest[held, 1].min() > 0.04
    sim.engine.run(60)
    world = sim.fetch()
    down = world.rest[:, 1] - world.x[:, 1]
    assert not down[held].any() and 1e-3 < down.max() < 0.1
    stretch = np.abs(np.diff(world.x[body.mesh.tets], axis=1) - np.diff(world.rest[body.mesh.tets], axis=1)).max((1, 2))
    assert stretch[inside].mean() < stretch[~inside].mean()


@pytest.mark.skipif(find_spec("pytetwild") is None, reason="pytetwild is not installed")
def test_its_surface_is_filled(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(fill, "cache_folder", lambda: tmp_path)
    source = 'object.liver.mesh={ surface = "organ.stl", edge = 0.03, scale = 0.001 }'
    effects = "object.liver.effects={ corotational = { young = 5e3, poisson = 0.45 }, fixed = { where = 'Y > 0.05' } }"
    sim = Simulation(load(folder / "organ.toml", [source, effects]))
    np.testing.assert_allclose(sim.world.bodies[0].mesh.volumes.sum(), organ()[0].volumes.sum(), rtol=0.02)
    sim.engine.run(5)
    assert sim.fetch().x[:, 1].min() < sim.world.rest[:, 1].min()
