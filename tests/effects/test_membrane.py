# SPDX-License-Identifier: MIT
"""Membranes on surfaces: stress, a balloon, slopes of energy and forces, tension at rest, motion, what is refused."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from sim_server.errors import InputError
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.effects.hollow import hollow, loaded, sphere
from tests.scenes import bar, rotation, scene
from tests.texts import module_in

YOUNG, THICKNESS = 1e5, 1e-3
TOP = {"young": YOUNG, "thickness": THICKNESS, "where": "Z > 0.999"}


def covered(membrane: dict[str, Any], integrator: Any = None, dt: float = 1.0, **table: Any) -> Simulation:
    """A bar of 2 x 1 x 1 m, of no material of its own unless it is given `young`."""
    solver = table.pop("solver", {})
    given = bar(**{"young": None, "density": 1000, **table})
    given["effects"]["membrane"] = membrane
    return Simulation(scene(given, integrator=integrator, dt=dt, **solver))


def pulled(sim: Simulation, stretch: tuple[float, float]) -> tuple[float, float]:
    """Forces by width that hold the membrane stretched along x and y [N/m]."""
    w = sim.world
    w.x[:] = w.rest * [*stretch, 1.3]
    sim.engine.assemble()
    force = sim.system.b / w.dt
    return -force[w.rest[:, 0] > 1.999, 0].sum() / 1, -force[w.rest[:, 1] > 0.999, 1].sum() / 2


def stress(a: float, b: float, poisson: float) -> tuple[float, float]:
    """Nominal stress of the compressible neo-Hookean solid in plane stress, stretched by a and b [Pa]."""
    mu, lame = YOUNG / (2 * (1 + poisson)), YOUNG * poisson / ((1 + poisson) * (1 - 2 * poisson))
    c = brentq(lambda c: mu * (c - 1 / c) + lame / c * np.log(a * b * c), 1e-3, 1e3, xtol=1e-15)
    return tuple(mu * (s - 1 / s) + lame / s * np.log(a * b * c) for s in (a, b))  # type: ignore[return-value]


@pytest.mark.parametrize(("stretch", "poisson"), [((1.5, 1.0), 0.3), ((1.2, 1.7), 0.45), ((1.4, 0.9), 0.0)])
def test_forces_at_the_edges_are_those_of_plane_stress(stretch, poisson):
    found = pulled(covered(TOP | {"poisson": poisson}), stretch)
    np.testing.assert_allclose(found, THICKNESS * np.array(stress(*stretch, poisson)), rtol=1e-9)


def test_one_that_keeps_its_volume_is_rubber():
    sim = covered(TOP | {"poisson": 0.5})
    mu = YOUNG / 3 * THICKNESS
    assert pulled(sim, (2.0, 2**-0.5)) == pytest.approx((mu * (2 - 1 / 4), 0), rel=1e-12, abs=1e-12)  # uniaxial
    assert pulled(sim, (1.5, 1.5)) == pytest.approx((mu * (1.5 - 1.5**-5),) * 2, rel=1e-12)  # of all sides


def test_a_balloon_follows_its_curve_of_pressure(tmp_path):
    """p = 2 mu t / R (1 / s - 1 / s^7), s the stretch, of thin rubber: Laplace's law with the stress at s."""
    inner, thickness, stretch = 0.9, 0.01, 1.1
    where = f"X*X + Y*Y + Z*Z < {(inner + 1e-3) ** 2}"
    pressure = 2 * YOUNG / 3 * thickness / inner * (1 / stretch - 1 / stretch**7)
    given = hollow(tmp_path, {"where": where, "pressure": pressure}, sphere(8, inner, 1.0))
    given["effects"] |= {
        "corotational": {"young": 1.0, "poisson": 0.0},
        "membrane": {"young": YOUNG, "poisson": 0.5, "thickness": thickness, "where": where},
        "fixed": [{"where": f"abs({axis}) < 1e-6", "along": axis.lower()} for axis in "XYZ"],
    }
    sim = loaded(given, {"scheme": "quasi_static", "linearizations": 40}, 1.0, preconditioner="cholesky",
                 update="every-1")  # fmt: skip
    assert Driver(sim).advance(2)["status"].tolist() == [0, 0]
    wall = np.linalg.norm(sim.world.rest, axis=1) < inner + 1e-3
    found = np.linalg.norm(sim.fetch().x[wall], axis=1).mean() / inner
    assert found - 1 == pytest.approx(stretch - 1, rel=0.07)  # of a polyhedron


@pytest.fixture(scope="module")
def cover() -> Simulation:
    """The whole outside of a bar."""
    return covered({"young": YOUNG, "poisson": 0.4, "thickness": THICKNESS}, cells=(2, 1, 1), solver={"warp": False})


def tangent(sim: Simulation) -> np.ndarray:
    sim.engine.assemble()
    return np.asarray(sim.matrix().toarray() - np.diag(np.repeat(sim.world.mass, 3)))


def test_forces_and_tangent_are_slopes(cover):
    x, shake = cover.world.x, np.random.default_rng(0).normal(size=cover.world.x.shape)
    x[:] = start = 1.4 * cover.world.rest + 0.03 * shake
    matrix, force = tangent(cover), cover.system.b.copy().ravel()
    of_energy, of_force = np.zeros(x.size), np.zeros((x.size, x.size))
    for k in range(x.size):
        for sign in (1, -1):
            x[:] = start
            x.ravel()[k] += sign * 1e-5
            cover.engine.assemble()
            of_energy[k] -= sign * cover.potential_energy() / 2e-5
            of_force[k] -= sign * cover.system.b.ravel() / 2e-5
    np.testing.assert_allclose(force, of_energy, atol=1e-8 * np.abs(force).max())
    np.testing.assert_allclose(matrix, of_force, atol=1e-8 * np.abs(matrix).max())


def test_the_tangent_is_never_indefinite(cover):
    """Compressed, folded and nearly flat."""
    for seed, size in enumerate((0.7, 0.3, 1e-3)):
        shake = 0.1 * size * np.random.default_rng(seed).normal(size=cover.world.x.shape)
        cover.world.x[:] = cover.world.rest * [size, 0.9, 0.9] + shake
        matrix = tangent(cover)
        assert np.isfinite(cover.system.b).all()
        assert np.linalg.eigvalsh(matrix).min() > -1e-12 * np.abs(matrix).max()


@pytest.mark.parametrize("size", [0.0, 0.3])
def test_single_precision_agrees(cover, size):
    """As a GPU has it; at rest stretches are equal and eigenvalues zero."""
    effect: Any = cover.effects["membrane"]
    x, m = cover.world.rest + size * np.random.default_rng(3).normal(size=cover.world.rest.shape), len(effect.elements)
    found = []
    for real, dtype in (("float", "f4"), ("double", "f8")):
        arrays = {"x": x, "v": 0 * x, "gradients": effect.gradients, "volume": effect.volume,
                  "constants": effect.constants, "stiffness_coefficient": np.ones(m)}  # fmt: skip
        given = {name: array.astype(dtype) for name, array in arrays.items()}
        out = {"corners": np.zeros((4, m, 9), dtype), "edges": np.zeros((6, m, 9), dtype)}
        module_in("effects/membrane.cu", real).bind("elements", m, corner=effect.elements, h=1.0, **given, **out)()
        found.append(out)
    for name in out:
        bound = 1e-5 * np.abs(found[1]["edges"]).max()
        assert np.abs(found[0][name] - found[1][name]).max() < bound, name


def test_a_rigid_motion_makes_no_force(cover):
    cover.world.x[:] = cover.world.rest @ rotation([1, 2, 3], 2.0).T + [3, -1, 2]
    cover.engine.assemble()
    assert np.abs(cover.system.b).max() < 1e-12 * YOUNG * THICKNESS
    assert cover.potential_energy() < 1e-12


def test_tension_at_rest_follows_its_parameter_and_is_work():
    """Nominal stress by the lengths of the rest shape, which are 1.1 times those without stress."""
    sim = covered(TOP | {"poisson": 0.5, "prestretch": 1.0, "density": 900.0}, dt=0.01, fixed="Z > 0.01")
    assert sim.world.mass.sum() == pytest.approx(2000 + 900 * THICKNESS * 2)
    driver = Driver(sim)
    driver.advance(1)
    sim.parameters.set({"bar.membrane.prestretch": "1.1"})
    records = driver.advance(2)
    mu = YOUNG / 3 * THICKNESS
    energy = 2 / 1.1**2 * mu / 2 * (2 * 1.1**2 + 1.1**-4 - 3)
    assert records["work"][-1] == pytest.approx(energy, rel=1e-9) == sim.potential_energy()
    assert pulled(sim, (1, 1)) == pytest.approx((mu * (1.1 - 1.1**-5) / 1.1,) * 2, rel=1e-9)


SCHEMES: list[dict[str, Any]] = [
    {"linearizations": 8}, {"scheme": "newmark"}, {"scheme": "ros2", "solve": "iterate"},
    {"scheme": "central_difference"}, {"scheme": "generalized_alpha"},
]  # fmt: skip


@pytest.mark.parametrize("integrator", SCHEMES, ids=lambda i: i.get("scheme", "Newton"))
def test_a_body_that_its_membrane_squeezes_keeps_its_energy(integrator):
    explicit = integrator.get("scheme") == "central_difference"
    sim = covered({"young": 1e6, "poisson": 0.4, "thickness": 0.01, "prestretch": 1.1}, integrator, 0.001,
                  young=1e5, solver={} if explicit else {"tolerance": 1e-10})  # fmt: skip
    start = sim.potential_energy()
    records = Driver(sim).advance(40)
    assert (records["status"] == 0).all()
    kinetic = sim.kinetic_energy()
    assert kinetic > 0.01 * start
    lost = 1 - (kinetic + sim.potential_energy()) / start
    assert -0.01 < lost < (0.2 if "linearizations" in integrator else 0.01)  # backward Euler damps


@pytest.mark.parametrize(
    ("membrane", "more", "said"),
    [
        ({"poisson": 0.6}, {}, "less than or equal to 0.5"),
        ({"poisson": 0.3, "where": "Z > 5"}, {}, "holds all nodes of 0 of"),
        ({"poisson": 0.3, "thickness": 0.0}, {}, "greater than 0"),
        ({"poisson": 0.3}, {"cutting": {}}, "elements cannot be removed with the effect membrane"),
    ],
)
def test_what_is_refused(membrane, more, said):
    given = bar(density=1000)
    given["effects"] |= {"membrane": TOP | membrane} | more
    with pytest.raises((InputError, ValueError), match=said):
        Simulation(scene(given))
