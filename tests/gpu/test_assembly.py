# SPDX-License-Identifier: MIT
"""A, b and the rotations of a step as a GPU makes them, beside the CPU's. Runs where there is one: pytest -m gpu."""

from typing import Any

import numpy as np
import pytest

from sim_server.backends.cpu.device import Cpu
from sim_server.scene import load
from sim_server.simulation import Simulation

pytestmark = pytest.mark.gpu

ARRAYS = ("values", "b_material", "y", "rotation")
INSTEAD = "object.beam.effects.corotational=false"
PATCHES = "object.beam.elements=patch"


def law(name: str, projection: str = "clamp", **constants: Any) -> list[str]:
    """Overrides for a beam of another law."""
    given = [f"object.beam.effects.{name}.{key}={value}" for key, value in constants.items()]
    return [INSTEAD, *given, f'solver.projection="{projection}"']


ELASTIC = {"young": 5e5, "poisson": 0.4}
CASES = {  # scene, overrides, how far nodes are moved [m], cells being 0.2 m
    "as it stands": ("beam", [], 0.0),
    "stirred": ("beam", [], 0.02),
    "inverted elements": ("beam", [], 0.2),
    "one element a node": ("beam", ["object.beam.mesh.bar=[1, 1, 1]", "object.beam.mesh.size=[1, 1, 1]"], 0.1),
    "several bodies": ("four_beams", [], 0.05),
    "regions": ("heterogeneous", [], 0.02),
    "posed": ("posed", [], 0.02),
    "without warp": ("beam", ["solver.warp=false"], 0.02),
    "rotations by qr": ("beam", ['object.beam.effects.corotational.rotation="qr"'], 0.05),
    "exact tangent": ("beam", ['object.beam.effects.corotational.tangent="exact"'], 0.02),
    "springs": ("beam", ["object.beam.effects.corotational=false", "object.beam.effects.mass_spring.young=2e5"], 0.02),
    "springs among elements": ("beam", ["object.beam.effects.mass_spring.young=2e5"], 0.02),
    "st_venant_kirchhoff, inverted": ("beam", law("st_venant_kirchhoff", **ELASTIC), 0.2),
    "neo_hookean": ("beam", law("neo_hookean", **ELASTIC), 0.02),
    "neo_hookean, not projected": ("beam", law("neo_hookean", "none", **ELASTIC), 0.02),
    "neo_hookean, regularized": ("beam", law("neo_hookean", inversion='"regularize"', **ELASTIC), 0.1),
    "stable_neo_hookean, absolute": ("beam", law("stable_neo_hookean", "absolute", **ELASTIC), 0.05),
    "stable_neo_hookean, excess": ("beam", law("stable_neo_hookean", "excess", **ELASTIC), 0.05),
    "mooney_rivlin": ("beam", law("mooney_rivlin", c1=5e4, c2=3e4, bulk=8e5), 0.02),
    "arruda_boyce": ("beam", law("arruda_boyce", shear=1e5, segments=5.0, bulk=8e5), 0.02),
    "veronda_westmann": ("beam", law("veronda_westmann", c1=3e4, c2=3.0, bulk=8e5), 0.02),
    "neo_hookean, patches": ("beam", [*law("neo_hookean", **ELASTIC), PATCHES], 0.02),
    "stable_neo_hookean, patches": ("beam", [*law("stable_neo_hookean", "excess", **ELASTIC), PATCHES], 0.05),
    "mooney_rivlin, patches": ("beam", [*law("mooney_rivlin", c1=5e4, c2=3e4, bulk=8e5), PATCHES], 0.02),
    "ogden": ("beam", law("ogden", mu=[6e4, -1e4], alpha=[1.3, -2.0], bulk=8e5), 0.02),
    "costa": ("beam", law("costa", a=9e3, bulk=8e5, fibre=[1, 0.2, 0], sheet=[0, 1, 0.3]), 0.02),
    "fibres beside": (
        "beam",
        ["object.beam.effects.fibres.stiffness=5e4", "object.beam.effects.fibres.direction=[1, 0, 1]"],
        0.02,
    ),
    "large thread blocks": ("beam", ["object.beam.mesh.bar=[14, 14, 56]"], 0.01),
}
BOUND = {"float64": 1e-13, "mixed": 5e-6, "float32": 5e-5}  # of the largest entry; worst where elements are inverted
INVERTED = {"float64": 1e-12, "mixed": 1e-4, "float32": 1e-3}


def stir(sim: Simulation, size: float) -> None:
    """Moves nodes and gives them velocities, on the device too."""
    random, w = np.random.default_rng(1), sim.world
    for array, most in ((w.x, size), (w.v, 1.0), (sim.system.dv, 1.0)):
        array += random.uniform(-most, most, array.shape)
        if not isinstance(w.backend, Cpu):
            twin = w.backend.twin(array)
            twin.set(array.astype(twin.dtype))


def assembled(case: str, precision: str | None, push: bool = False) -> Simulation:
    """After the first half of a step; precision None: on the CPU."""
    scene, overrides, size = CASES[case]
    device = "gpu" if precision else "cpu"
    more = [f"solver.precision={precision}"] if precision else []
    path = f"deploy/scenes/{scene}.toml"
    sim = Simulation(load(path, [*overrides, *more]), device)
    if push:
        touch: Any = sim.effects["touch"]
        name = sim.world.bodies[0].name
        far = tuple(sim.world.x[sim.world.free > 0].max(axis=0))
        touch.push("me", name, far, 0.3, (800.0, 0.0, 0.0), 0.1)
        touch.grab("me", name, far, 0.5, (far[0], far[1] + 0.1, far[2]), 1e4, 5000.0, 0.1)
        touch.grab("me", name, far, 0.0, (far[0], far[1] + 9.0, far[2]), 1e9, 50.0, 0.1)
    stir(sim, size)
    sim.engine.assemble()
    for name in ARRAYS:
        sim.world.backend.fetch(getattr(sim.system, name))
    return sim


@pytest.mark.parametrize("precision", BOUND)
@pytest.mark.parametrize("case", CASES)
def test_it_is_the_cpus(case, precision):
    found, expected = assembled(case, precision), assembled(case, None)
    wide = case == "inverted elements" or any(INSTEAD in o or "fibres" in o for o in CASES[case][1])
    bound = (INVERTED if wide else BOUND)[precision]  # laws project an eigenvalue near zero, or do not
    for name in ARRAYS:
        a, b = getattr(found.system, name), getattr(expected.system, name)
        assert np.abs(a - b).max() <= bound * np.abs(b).max(), name
    for body in range(len(found.world.bodies)):
        A = found.matrix(body)
        assert abs(A - A.T).max() == 0, "symmetric to the last bit"


@pytest.mark.parametrize("precision", BOUND)
def test_pushes_and_grabs_are_the_cpus(precision):
    found, expected = assembled("stirred", precision, push=True), assembled("stirred", None, push=True)
    untouched = assembled("stirred", None)
    for name in ("values", "b_material"):
        a, b = getattr(found.system, name), getattr(expected.system, name)
        assert np.abs(a - b).max() <= BOUND[precision] * np.abs(b).max(), name
        assert np.abs(b - getattr(untouched.system, name)).max() > 1e-6 * np.abs(b).max(), "something was pushed"


@pytest.mark.parametrize("precision", BOUND)
def test_the_same_bits_every_time(precision):
    one, two = assembled("stirred", precision), assembled("stirred", precision)
    for name in ARRAYS:
        assert np.array_equal(getattr(one.system, name), getattr(two.system, name)), name
