# SPDX-License-Identifier: MIT
"""The two exact properties of the warp, for every effect that deforms: a body turned as a whole needs one iteration
with the factor of the unturned one, and a posed scene takes as many iterations as the unposed."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.kinds import Kind
from sim_server.effects import known_effects
from sim_server.mesh import pose_matrix
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, factor_of, rotation, simulation
from tests.solver.solves import solve

USUAL = {"young": 4e5, "poisson": 0.35}
MODELS: dict[str, dict[str, Any]] = {
    "corotational": {"corotational": USUAL},
    "corotational, QR": {"corotational": USUAL | {"rotation": "qr"}},
    "springs": {"mass_spring": {"young": 4e5}},
    "St Venant-Kirchhoff": {"st_venant_kirchhoff": USUAL},
    "neo-Hookean": {"neo_hookean": USUAL},
    "stable neo-Hookean": {"stable_neo_hookean": USUAL},
    "Mooney-Rivlin": {"mooney_rivlin": {"c1": 5e4, "c2": 2e4, "bulk": 5e5}},
    "Arruda-Boyce": {"arruda_boyce": {"shear": 1.4e5, "segments": 8.0, "bulk": 5e5}},
    "Ogden": {"ogden": {"mu": [1.4e5], "alpha": [3.0], "bulk": 5e5}},
    "prony": {"corotational": USUAL, "prony": {"terms": [{"g": 2.0, "tau": 0.1}]}},
    "plasticity": {"corotational": USUAL, "plasticity": {"yield_stress": 1e3, "hardening": 1e4}},
    "fibres": {"neo_hookean": USUAL, "fibres": {"stiffness": 2e5, "direction": [1, 0.5, 0]}},
}  # fmt: skip
POSE = (40.0, 0.0, 70.0)


@pytest.fixture(params=MODELS)
def effects(request) -> dict[str, Any]:
    """Effects of an object; skips if there is no such effect."""
    table = MODELS[request.param]
    if missing := set(table) - set(known_effects()):
        pytest.skip(f"no effect {missing}")
    return table


def body(effects: dict[str, Any], cells: tuple[int, int, int], size: tuple[float, float, float], **more: Any) -> dict:
    """A bar of the given effects."""
    table = bar(cells, size, young=None, **more)
    return {**table, "effects": table["effects"] | effects}


def turned(sim: Simulation, R: NDArray) -> None:
    """Positions and velocities; then the first half of a step."""
    sim.world.x[:], sim.world.v[:] = sim.world.x @ R.T + [1.0, 2.0, 3.0], sim.world.v @ R.T
    sim.engine.assemble()


def test_a_turned_body_needs_one_iteration_with_the_factor_of_the_unturned_one(effects):
    solver = {"tolerance": 1e-6, "warm_start": False, "factor_precision": "float64", "preconditioner": "cholesky"}
    sim = simulation(body(effects, (5, 2, 2), (2.5, 1, 1)), **solver)
    random = np.random.default_rng(0)
    sim.world.x[:] += random.normal(scale=0.01, size=sim.world.x.shape)
    sim.world.v[:] = random.normal(scale=0.1, size=sim.world.x.shape)
    sim.engine.assemble()
    sim.engine.post_factor(0, *factor_of(sim), step=0)
    for axis, degrees in (((0, 0, 1), 0), ((1, 2, 3), 35), ((1, -2, 0.5), 90), ((-0.3, 0.4, 2), 180)):
        x, v = sim.world.x.copy(), sim.world.v.copy()
        turned(sim, rotation(axis, np.radians(degrees)))
        _, record = solve(sim)
        assert (record["status"], record["kind"], record["iterations"]) == (0, Kind.CHOLESKY, 1)
        sim.world.x[:], sim.world.v[:] = x, v


def falling(effects: dict[str, Any], pose: tuple[float, float, float] | None, warp: bool) -> NDArray:
    """Iterations of each step of a beam that bends under its weight."""
    frame: dict[str, Any] = {"pose": {"rotate": list(pose)}} if pose else {}
    g = (pose_matrix(pose) if pose else np.eye(3)) @ [0, -9.81, 0]
    beam = body(effects, (8, 2, 2), (5, 1.2, 1.2), fixed="X < 0.01", damping=(0.1, 0.01), **frame)
    sim = simulation(beam, gravity=tuple(g), preconditioner="cholesky", update="lockstep-8", warp=warp)
    records = Driver(sim).advance(48)
    assert (records["status"] == 0).all()
    return records["iterations"][16:]  # not those with the factor of rest, where rounding decides if fibres pull


def test_a_posed_scene_takes_as_many_iterations_as_the_unposed(effects):
    plain, posed = falling(effects, None, True), falling(effects, POSE, True)
    assert np.abs(posed - plain).max() <= 1
    assert posed.mean() == pytest.approx(plain.mean(), rel=0.05)
    assert plain.mean() < 0.9 * falling(effects, None, False).mean()
