# SPDX-License-Identifier: MIT
"""The texts of materials that remember, built with real = float, agree with double precision, as a GPU has them."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.effects._history import TetrahedraWithHistory
from sim_server.simulation import Simulation
from tests.scenes import bar, simulation
from tests.texts import module_in

LAW = {"young": 1e5, "poisson": 0.3}
EFFECTS: dict[str, dict[str, Any]] = {
    "prony": {"terms": [{"g": 0.8, "tau": 0.03}, {"g": 0.3, "tau": 50.0}]},
    "plasticity": {"yield_stress": 500.0, "hardening": 5e3, "kinematic": 3e3},
    "damage": {"strength": 500.0, "fracture_energy": 100.0},
    "damage by energy": {"strength": 500.0, "fracture_energy": 100.0, "measure": "energy"},
}


def made(name: str, size: float) -> tuple[Simulation, TetrahedraWithHistory]:
    """A deformed body with a memory."""
    effect = name.split()[0]
    sim = simulation(bar((3, 2, 2), (1.5, 1, 1), young=None, effects={"corotational": LAW, effect: EFFECTS[name]}))
    random = np.random.default_rng(4)
    sim.world.x += random.normal(scale=size, size=sim.world.x.shape)
    found = next(e for e in sim.effects.values() if isinstance(e, TetrahedraWithHistory))
    for key, array in found.memory.items():
        values = (
            random.uniform(0, 1, array.shape) if key in ("largest", "hardened") else random.normal(size=array.shape)
        )
        array[...] = 0.3 * size * values
    found.last *= 0.9  # as if parameters had changed since
    return sim, found


def results(sim: Simulation, effect: TetrahedraWithHistory, real: str) -> dict[str, NDArray]:
    """What its kernels write, in float64 for comparison; the memory itself stays."""
    elements = next(x for x in sim.launches()[0] if x.name.endswith(f"{effect.name}.elements"))
    found, text = {}, module_in(effect.text, real)
    for launch in (elements, effect.energies().launch, *effect.history()):
        arrays = {
            name: array.astype("f8" if real == "double" else "f4") if array.dtype == np.float64 else array
            for name, array in launch.arrays.items()
        }
        numbers = {f.name: getattr(launch.params, f.name) for f in launch.fields[1:] if f.dtype is None}
        kernel = launch.name.split(".")[-1]
        text.bind(kernel, launch.items, **arrays, **numbers)()
        found |= {f"{kernel} {name}": arrays[name].astype(float) for name, _ in launch.written()}
    return found


@pytest.mark.parametrize("size", [5e-3, 0.05])
@pytest.mark.parametrize("name", EFFECTS)
def test_single_precision_agrees(name: str, size: float) -> None:
    """Strains have the rounding of F, which is 1: forces, too."""
    sim, effect = made(name, size)
    single, double = (results(sim, effect, real) for real in ("float", "double"))
    assert {k.split()[0] for k in double} == {"elements", "energy", "advance"}
    for key, expected in double.items():
        scale = np.abs(expected).max()
        assert scale > 0, key
        assert np.abs(single[key] - expected).max() < max(1e-4, 3e-6 / size) * scale, key
