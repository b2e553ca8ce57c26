# SPDX-License-Identifier: MIT
"""Rods inside objects: bending, stretch beside the object, slopes, sutures, motion, and what is refused."""

from typing import Any

import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.mesh import bar as bar_mesh
from sim_server.parameters import BadParameter
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, mesh_file, rotation, scene

STATIC = {"scheme": "quasi_static", "linearizations": 20}
YOUNG, RADIUS = 1e9, 0.02
AREA, INERTIA = np.pi * RADIUS**2, np.pi * RADIUS**4 / 4
AXIS = [[0, 0.51, 0.47], [2, 0.51, 0.47]]
ARC = [[1 - np.cos(0.1 * k * np.pi), 0.3, 0.1 + 0.8 * np.sin(0.1 * k * np.pi)] for k in range(11)]
FEW = {"cells": (2, 1, 1), "young": None}


def with_rod(rod: Any, integrator: dict | None = None, dt: float = 1.0, **table: Any) -> Simulation:
    """A bar of 2 x 1 x 1 m, of no material if `young` is None."""
    solver, gravity = table.pop("solver", {}), table.pop("gravity", None)
    effects = {name: table.pop(name) for name in ("fixed", "traction", "cutting") if name in table}
    if table.get("young", YOUNG) is not None:
        table["poisson"] = 0.0
    given = bar(**{"density": 1000, **table})
    given["effects"] |= {"rod": rod} | effects
    return Simulation(scene(given, integrator=integrator, dt=dt, gravity=gravity, **solver))


def rod(path: Any = AXIS, **more: Any) -> dict[str, Any]:
    return {"path": path, "young": YOUNG, "radius": RADIUS} | more


def points(sim: Simulation, x: np.ndarray) -> np.ndarray:
    """Points of a rod that begins where a node was at x = 0, as sums of its segments, (k, 3)."""
    effect: Any = sim.effects["rod"]
    segments = effect.length > 1e-3  # of a straight rod
    d = np.einsum("sc,scd->sd", effect.weights[segments], x[effect.elements[segments]])
    return np.concatenate([[np.zeros(3)], np.cumsum(d, axis=0)])


def test_a_rod_in_a_soft_bar_bends_by_its_weight_as_a_beam():
    """By the sum of its turns, and by w L^4 / (8 E I) up to the square of a segment's length over L."""
    weight = 100 * 9.81 * AREA
    path = [[0, 0.21, 0.2], [2, 0.21, 0.2]]
    sim = with_rod(rod(path, density=100.0), STATIC, cells=(20, 2, 2), size=(2, 0.4, 0.4), young=1.0, density=1e-9,
                   fixed={"where": "X < 0.41"}, gravity=(0, 0, -9.81),
                   solver={"preconditioner": "cholesky", "update": "every-1", "tolerance": 1e-9})  # fmt: skip
    assert Driver(sim).advance(1)["status"].tolist() == [0]
    s, sag = points(sim, sim.world.rest)[:, 0], -points(sim, sim.fetch().x)[:, 2]
    part = np.diff(s)
    share = np.append(part, 0) / 2 + np.append(0, part) / 2
    clamp = int(np.flatnonzero(np.abs(sag) < 1e-12)[-1])
    bent = np.where(np.arange(len(s)) == clamp, part[clamp] / 2, share)
    arms = s[:, None] - s  # from column to row
    turns = weight * (np.tril(arms) * share[:, None]).sum(axis=0) * bent / (YOUNG * INERTIA)
    assert sag[-1] == pytest.approx(turns[clamp:] @ arms[-1, clamp:], rel=1e-3)
    free = s[-1] - s[clamp]
    assert sag[-1] == pytest.approx(weight * free**4 / (8 * YOUNG * INERTIA), rel=(part[0] / free) ** 2)


def test_a_rod_adds_its_section_to_that_of_the_bar():
    """The rule of mixtures, with the same E A of both: half of the extension, away from the end that is pulled."""
    path = [[0, 0.24, 0.26], [4, 0.24, 0.26]]
    planes = [{"where": "X < 0.01", "along": "x"}, {"where": "true", "along": ["y", "z"]}]
    sim = with_rod(rod(path, young=1e5 * 0.25 / AREA), STATIC, cells=(16, 2, 2), size=(4, 0.5, 0.5), fixed=planes,
                   traction={"where": "X > 3.99", "force": [500, 0, 0]},
                   solver={"tolerance": 1e-9, "max_iterations": 5000})  # fmt: skip
    assert Driver(sim).advance(1)["status"].tolist() == [0]
    w = sim.fetch()
    ends = [w.x[np.abs(w.rest[:, 0] - x) < 1e-6, 0].mean() for x in (1, 2)]
    assert ends[1] - ends[0] - 1 == pytest.approx(500 / (2 * 0.25e5), rel=0.01)
    w.x[:] = w.rest * [1.01, 1, 1]
    assert sim.potential_energy() == pytest.approx(0.25e5 * 0.01**2 * 4, rel=1e-6)


@pytest.fixture(scope="module")
def laid() -> Simulation:
    """A straight and a curved rod in nodes that nothing else holds together."""
    return with_rod([rod(), rod(ARC, prestretch=0.9)], **FEW, solver={"warp": False})


def tangent(sim: Simulation) -> np.ndarray:
    sim.engine.assemble()
    return np.asarray(sim.matrix().toarray() - np.diag(np.repeat(sim.world.mass, 3)))


def test_forces_are_slopes_of_the_energy_and_the_tangent_those_of_forces():
    """All of it where a straight rod is stretched; anywhere it is semi-definite."""
    sim = with_rod(rod(), **FEW, solver={"warp": False})
    shake = np.random.default_rng(0).normal(size=sim.world.x.shape)
    x = sim.world.x
    x[:] = start = 1.3 * sim.world.rest + 0.05 * shake
    matrix, force = tangent(sim), sim.system.b.copy().ravel()
    of_energy, of_force = np.zeros(x.size), np.zeros((x.size, x.size))
    for k in range(x.size):
        for sign in (1, -1):
            x[:] = start
            x.ravel()[k] += sign * 1e-5
            sim.engine.assemble()
            of_energy[k] -= sign * sim.potential_energy() / 2e-5
            of_force[k] -= sign * sim.system.b.ravel() / 2e-5
    np.testing.assert_allclose(force, of_energy, atol=1e-8 * np.abs(force).max())
    np.testing.assert_allclose(matrix, of_force, atol=1e-8 * np.abs(matrix).max())


def test_the_tangent_is_never_indefinite(laid):
    for size in (1.3, 0.6, 1e-3):
        laid.world.x[:] = size * laid.world.rest + 0.1 * np.random.default_rng(1).normal(size=laid.world.x.shape)
        matrix = tangent(laid)
        assert np.linalg.eigvalsh(matrix).min() > -1e-12 * np.abs(matrix).max()


def test_forces_have_neither_sum_nor_torque_and_rest_shapes_none():
    sim = with_rod([rod(), rod(ARC)], **FEW)
    w = sim.world
    w.x[:] = w.rest @ rotation([1, 2, 3], 2.0).T + [3, -1, 2]
    sim.engine.assemble()
    assert np.abs(sim.system.b).max() < 1e-9 * YOUNG * AREA and sim.potential_energy() < 1e-12
    w.x[:] += 0.1 * np.random.default_rng(1).normal(size=w.x.shape)
    sim.engine.assemble()
    force = sim.system.b
    assert np.abs(force).max() > 1e-3 * YOUNG * AREA
    np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-12 * np.abs(force).max())
    np.testing.assert_allclose(np.cross(w.x, force).sum(axis=0), 0, atol=1e-11 * np.abs(force).max())


def test_a_suture_across_a_gap_pulls_the_lips_together(tmp_path):
    """Two cubes 0.3 m apart in one object; where the path crosses the gap it is one segment."""
    mesh = bar_mesh((2, 2, 2), (1, 1, 1), "kuhn")
    n, other = len(mesh.rest), mesh.rest + np.array([1.3, 0, 0])
    given = bar(density=1000, mesh=mesh_file(
        tmp_path, np.concatenate([mesh.rest, other]), np.concatenate([mesh.tets, mesh.tets + n])
    ), damping=(5.0, 0.0))  # fmt: skip
    path = [[0.6, 0.52, 0.47], [1.7, 0.52, 0.47]]
    given["effects"] |= {"fixed": {"where": "X < 0.01"}, "rod": rod(path, young=1e7, radius=0.01, prestretch=1.0)}
    sim = Simulation(scene(given, dt=0.05))
    driver = Driver(sim)
    driver.advance(1)
    assert points(sim, sim.fetch().x)[-1, 0] == pytest.approx(1.1)
    sim.parameters.set({"bar.rod.prestretch": "1.2"})
    assert (driver.advance(150)["status"] == 0).all()
    x = sim.fetch().x
    assert x[n:, 0].min() - x[:n, 0].max() < 0.2
    assert points(sim, x)[-1, 0] == pytest.approx(1.1 / 1.2, rel=0.01)  # nothing else holds the second cube


def test_density_adds_the_mass_of_the_rod():
    sim = with_rod(rod(density=7850.0))
    assert sim.world.mass.sum() - 2000 == pytest.approx(7850 * AREA * 2)
    assert sim.world.mass @ sim.world.rest / sim.world.mass.sum() == pytest.approx(
        (2000 * np.array([1, 0.5, 0.5]) + 7850 * AREA * 2 * np.array([1, 0.51, 0.47])) / (2000 + 7850 * AREA * 2)
    )


SCHEMES: list[dict[str, Any]] = [
    {"linearizations": 8}, {"scheme": "newmark"}, {"scheme": "ros2", "solve": "iterate"},
    {"scheme": "central_difference"}, {"scheme": "generalized_alpha"},
]  # fmt: skip


@pytest.mark.parametrize("integrator", SCHEMES, ids=lambda i: i.get("scheme", "Newton"))
def test_a_body_that_a_rod_is_tied_through_keeps_its_energy(integrator):
    solver = {} if integrator.get("scheme") == "central_difference" else {"tolerance": 1e-10}
    sim = with_rod([rod(ARC, young=1e8, prestretch=1.2), rod(young=1e8)], integrator, 0.001, young=1e5, solver=solver)
    start = sim.potential_energy()
    records = Driver(sim).advance(40)
    assert (records["status"] == 0).all()
    kinetic = sim.kinetic_energy()
    assert kinetic > 0.01 * start
    lost = 1 - (kinetic + sim.potential_energy()) / start
    assert -0.01 < lost < (0.3 if "linearizations" in integrator else 0.01)  # backward Euler damps


def test_rods_of_a_list_keep_their_path():
    sim = with_rod([rod(), rod(ARC)])
    assert [p.field.short for p in sim.parameters if "rod" in p.field.short] == ["bar.rod.tables"]
    with pytest.raises(BadParameter, match="only young and prestretch"):
        sim.parameters.set({"bar.rod.tables": f"[{{ path = {AXIS}, young = 1e8, radius = 0.01 }}]"})


@pytest.mark.parametrize(
    ("given", "more", "said"),
    [
        (rod([[0, 0, 0], [2, 0, 1.2]]), {}, r"path: point 2, \(2, 0, 1.2\), lies outside the object"),
        (rod([[0, 0, 0]]), {}, "has 1 points: must have 2 to 1000"),
        (rod([[0, 0, 0], [0, 0, 0]]), {}, "same point twice"),
        ({"path": AXIS, "young": 1e9}, {}, "needs path, young and radius"),
        (rod([[1, 0.5, 0.5], [1.2, 0.6, 0.5], [1, 0.5, 0.5]]), {}, "ends where it begins, and no point in between"),
        (rod(tables=[rod()]), {}, "path: stands in the tables"),
        ({"tables": [rod()], "prestretch": 1.2}, {}, "prestretch: stands in the tables"),
        (rod(prestretch=3.0), {}, "less than or equal to 2"),
        (rod(), {"cutting": {}}, "elements cannot be removed with the effect rod"),
    ],
)
def test_what_is_refused(given, more, said):
    with pytest.raises((InputError, ValueError), match=said):
        with_rod(given, **more)
