# SPDX-License-Identifier: MIT
"""The laws' texts built with real = float agree with double precision, as a GPU in float32 or mixed has them."""

from pathlib import Path

import numpy as np
import pytest

from sim_server.effects._hyperelastic import PROJECTIONS
from tests.physics.laws import LAWS, Law, deform, odd_bar
from tests.texts import module_in


def in_precision(sim, law: Law, real: str) -> dict[str, np.ndarray]:
    """Results of the elements' kernels in the present state, in float64 for comparison."""
    dtype, effect = np.dtype("f8" if real == "double" else "f4"), sim.effects[law.name]
    m = len(effect.elements)
    out = {"corners": np.zeros((4, m, 9), dtype), "edges": np.zeros((6, m, 9), dtype)}
    inputs = {"x": sim.world.x, "gradients": effect.gradients, "volume": effect.volume, "constants": effect.constants}
    energy = {"energy": np.zeros(m, dtype)}
    if law.name == "fibres":
        path, inputs["directions"] = "effects/fibres.cu", effect.directions
        only: dict = {}
    else:
        path = effect.law.path
        inputs |= {"floor": effect.floor} if effect.law.regularizes else {}
        only = {"projection": PROJECTIONS["clamp"], "clock": np.zeros(1), "refused": effect.refused.copy()}
    given = {name: array.astype(dtype) for name, array in inputs.items()}
    step = {"v": sim.world.v.astype(dtype), "h": 0.02, "stiffness_coefficient": np.full(m, 0.02**2, dtype)}
    text = module_in(path, real)
    text.bind("elements", m, tets=effect.elements, **given, **step, **only, **out)()
    text.bind("energy", m, tets=effect.elements, **given, **energy)()
    return {name: array.astype(float) for name, array in (out | energy).items()}


CASES = {
    f"{name} {size}": (law, size) for name, law in LAWS.items() for size in ((0.1, 0.6) if law.inverts else (0.1,))
}


@pytest.mark.parametrize(("law", "size"), CASES.values(), ids=CASES.keys())
def test_single_precision_agrees(tmp_path: Path, law: Law, size: float):
    sim = odd_bar(tmp_path, law)
    deform(sim, size, seed=2)
    single, double = in_precision(sim, law, "float"), in_precision(sim, law, "double")
    for name, expected in double.items():
        assert np.abs(single[name] - expected).max() < 1e-4 * np.abs(expected).max(), name


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS.keys())
def test_at_rest_too(tmp_path: Path, law: Law):
    """At rest stretches are equal and eigenvalues zero."""
    sim = odd_bar(tmp_path, law)
    single, double = in_precision(sim, law, "float"), in_precision(sim, law, "double")
    bound = 1e-4 * np.abs(double["edges"]).max() + 1e-30
    assert np.abs(single["edges"] - double["edges"]).max() < bound
    assert np.abs(single["corners"] - double["corners"]).max() < bound
