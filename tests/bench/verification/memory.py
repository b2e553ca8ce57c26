# SPDX-License-Identifier: MIT
"""Materials that remember, in `bench verification`: bars under a load or a strain that changes, beside closed forms."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.bench.verification.row import Row, relative

YOUNG, POISSON = 1e4, 0.3
MU, BULK = YOUNG / 2.6, YOUNG / 1.2
SYMMETRY = [{"where": f"{axis} < 1e-4", "along": axis.lower()} for axis in "XYZ"]
SLIDING = [{"where": "X < 1e-4"}, {"where": "true", "along": ["y", "z"]}]
SOLID = "standard linear solid: Simo and Hughes 1998, section 10.3"


def specimen(dt: float, effects: dict[str, Any], **table: Any) -> Simulation:
    """A bar of 2 x 1 x 1 m without inertia."""
    body = {
        "name": "bar", "mesh": {"bar": [2, 1, 1], "size": [2, 1, 1]},
        "effects": {"corotational": {"young": YOUNG, "poisson": POISSON}, **effects},
    }  # fmt: skip
    integrator = {"scheme": "quasi_static", "linearizations": 30, "tolerance": 1e-10}
    solver = {"preconditioner": "block_jacobi", "tolerance": 1e-12, "max_iterations": 2000}
    scene = {"name": "memory", "dt": dt, "object": [body], "integrator": integrator, "solver": solver, **table}
    return Simulation(Scene.model_validate(scene))


def strained(dt: float, effects: dict[str, Any], strains: NDArray[Any]) -> NDArray[Any]:
    """Axial stress [Pa] after steps that end at these strains; the bar cannot contract sideways."""
    frames = [{"time": 0.0}] + [{"time": dt * (k + 1), "translate": [2 * e, 0, 0]} for k, e in enumerate(strains)]
    grip = {"name": "grip", "object": "bar", "where": "X > 1.99", "keyframes": frames}
    sim = specimen(dt, effects | {"fixed": {"tables": SLIDING}}, holder=[grip])
    found = []
    for _ in strains:
        sim.engine.run(1)
        found.append(-sim.world.reaction[0, 0, 0])
    return np.array(found)


def loaded(dt: float, effects: dict[str, Any], stress: float) -> Simulation:
    """A bar under a tensile stress [Pa], free to contract."""
    load = {"where": "X > 1.99", "stress": [stress, 0, 0]}
    return specimen(dt, effects | {"fixed": {"tables": SYMMETRY}, "traction": load})


def extension(sim: Simulation) -> float:
    """Axial strain now."""
    return float((sim.fetch().x[:, 0].max() - 2) / 2)


def viscoelasticity(quick: bool) -> list[Row]:
    """Relaxation, creep, and a sinusoid."""
    g, tau = 0.8, 0.2
    prony = {"prony": {"terms": [{"g": g, "tau": tau}]}}
    steps, dt, strain = 20, 0.05, 1e-2
    q = strain * tau / dt * (np.exp(dt / tau) - 1) * np.exp(-steps * dt / tau)
    reference = (BULK + 4 / 3 * MU) * strain + 4 / 3 * MU * g * q
    found = strained(dt, prony, np.full(steps, strain))[-1]
    rows = [relative("prony: stress 5 tau after a strain in a step", reference, found, 1e-6, SOLID)]
    dt = tau / (50 if quick else 400)
    sim = loaded(dt, prony, 1.0)
    sim.engine.run(round(tau / dt))
    compliance = (1 - g / (1 + g) * np.exp(-1 / (1 + g))) / MU
    rows.append(relative("prony: creep after tau", 1 / (9 * BULK) + compliance / 3, extension(sim), 5e-3, SOLID))
    cycle = 50 if quick else 200
    phase = 2 * np.pi / cycle * np.arange(1, 4 * cycle + 1)
    last = phase[-cycle:]
    stress = strained(2 * np.pi / 5 / cycle, prony, 1e-3 * np.sin(phase))[-cycle:]  # 5 rad/s: omega tau = 1
    both = np.linalg.lstsq(np.stack([np.sin(last), np.cos(last)], axis=1), stress, rcond=None)[0] / 1e-3
    storage, loss = 0.75 * (both[0] - BULK), 0.75 * both[1]
    rows.append(relative("prony: storage modulus of shear, omega tau = 1", MU * (1 + g / 2), storage, 5e-3, SOLID))
    rows.append(relative("prony: loss modulus of shear, omega tau = 1", MU * g / 2, loss, 5e-3, SOLID))
    return rows


def plasticity(quick: bool) -> list[Row]:
    """A bar that is loaded beyond its yield stress, and unloaded."""
    source = "bilinear stress-strain curve: Simo and Hughes 1998, section 1.2"
    flow = {"plasticity": {"yield_stress": 10.0, "hardening": 500.0, "kinematic": 1500.0}}
    sim = loaded(0.1, flow, 16.0)
    sim.engine.run(1)
    rows = [relative("plasticity: strain beyond the yield stress", 16 / YOUNG + 6 / 2000, extension(sim), 1e-6, source)]
    sim.parameters.set({"bar.traction.stress": "[0, 0, 0]"})
    sim.engine.run(1)
    return [*rows, relative("plasticity: strain that stays", 6 / 2000, extension(sim), 1e-6, source)]
