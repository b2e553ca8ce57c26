# SPDX-License-Identifier: MIT
"""Young's modulus and Poisson's ratio per element."""

import logging
from pathlib import Path

import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.scene import Scene, load
from sim_server.scene.regions import Region, region_values
from sim_server.simulation import Simulation

POINTS = np.array([[0.5, 0, 0], [1.5, 0, 0], [2.5, 0, 0]])


def test_one_value_for_all():
    young, poisson = region_values(1e6, 0.3, POINTS)
    assert young.tolist() == [1e6] * 3 and poisson.tolist() == [0.3] * 3


def test_first_region_that_holds_wins_and_the_last_takes_the_rest(caplog):
    regions = [
        Region(where="X < 1", young=1.0, poisson=0.1),
        Region(where="X < 2", young=2.0),
        Region(where="X < 1.5", young=9.0),
        Region(young=3.0, poisson=0.49),
    ]
    with caplog.at_level(logging.WARNING):
        young, poisson = region_values(regions, 0.3, POINTS)
    assert young.tolist() == [1, 2, 3] and poisson.tolist() == [0.1, 0.3, 0.49]
    assert "region 3 (where = 'X < 1.5', young = 9 Pa) holds no element" in caplog.text


def test_element_in_no_region():
    with pytest.raises(InputError) as error:
        region_values([Region(where="X < 1", young=1.0)], 0.3, POINTS)
    assert "element 1 with centroid (1.5, 0, 0) m is in no region of young (2 such elements)" in str(error.value)


def test_bands_of_the_heterogeneous_scene():
    scene = load(Path(__file__).parents[2] / "deploy" / "scenes" / "heterogeneous.toml")
    mesh = scene.objects[0].load_mesh()
    params = scene.objects[0].effects["corotational"]
    young, poisson = region_values(params.young, params.poisson, mesh.rest[mesh.tets].mean(axis=1))
    values, counts = np.unique(young, return_counts=True)
    assert values.tolist() == [5e4, 2.5e5, 5e6] and counts.tolist() == [1050, 1050, 1050]
    assert set(poisson) == {0.4}


def test_constants_that_every_region_gives_need_not_stand_beside_them(tmp_path):
    """Of all laws, vectors too; the scene as resolved loads again."""
    path = tmp_path / "scene.toml"
    path.write_text(
        'dt = 0.01\n[[object]]\nname = "a"\nmesh = { bar = [2, 1, 1], size = [2, 1, 1] }\n[object.effects]\n'
        'corotational = { young = [{ where = "X < 1", young = 1e4, poisson = -0.2 }, '
        "{ young = 2e4, poisson = 0.3 }] }\n"
        "mooney_rivlin = { c1 = [{ c1 = 1e3, c2 = 2e3, bulk = 3e4 }] }\n"
        "fibres = { stiffness = [{ where = 'X < 1', stiffness = 1, direction = [1, 0, 0] }, "
        "{ stiffness = 1, direction = [0, 0, 2] }] }\n"
    )
    scene = load(path)
    sim = Simulation(scene)
    young, poisson = sim.effects["corotational"].elastic[0]
    assert sorted(set(zip(young.tolist(), poisson.tolist(), strict=True))) == [(1e4, -0.2), (2e4, 0.3)]
    assert sim.effects["mooney_rivlin"].constants[:, 0].tolist() == [1e3, 2e3, 3e4]
    directions = sim.effects["fibres"].directions[:3].T
    assert {tuple(d) for d in directions.tolist()} == {(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)}
    assert Scene.model_validate(scene.resolved()).resolved() == scene.resolved()


def test_an_override_does_not_take_the_place_of_regions_unasked():
    scene = Path(__file__).parents[2] / "deploy" / "scenes" / "heterogeneous.toml"
    name = load(scene).objects[0].name
    key = f"object.{name}.effects.corotational.young"
    with pytest.raises(InputError) as error:
        load(scene, [f"{key}=1e6"])
    assert "young is a list of 3 regions in the scene" in str(error.value)
    assert str(error.value).endswith(f"{key}=[{{ young = 1e6 }}]")
    regions = load(scene, [f"{key}=[{{ young = 1e6 }}]"]).objects[0].effects["corotational"].young
    assert [(r.where, r.young) for r in regions] == [(None, 1e6)]
