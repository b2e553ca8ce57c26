# SPDX-License-Identifier: MIT
"""The texts of hyperelastic patches with real = float agree with double precision, as a GPU in float32 or mixed has
them."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.effects._hyperelastic import PROJECTIONS
from sim_server.simulation import Simulation
from tests.physics.laws import deform
from tests.physics.test_hyperelastic_patches import PATCHED, effect_of, patched
from tests.texts import module_in


def in_precision(sim: Simulation, real: str) -> dict[str, NDArray[np.float64]]:
    """Results of the kernels in the present state, in float64 for comparison."""
    effect, dtype = effect_of(sim), np.dtype("f8" if real == "double" else "f4")
    m, patches, h = len(effect.elements), len(effect.patch_volume), 0.02
    shapes = {"dilatation": (m, 2), "pressure": (patches, 2), "weight": patches, "corners": (4, m, 9),
              "edges": (6, m, 9), "areas": (4, m, 3)}  # fmt: skip
    out = {name: np.zeros(shape, dtype) for name, shape in shapes.items()}
    names = ("gradients", "volume", "constants", "floor", "patch_volume", "bulk", "patch_floor")
    given = {name: getattr(effect, name).astype(dtype) for name in names}
    of_elements = {"tets": effect.elements, "x": sim.world.x.astype(dtype), "v": sim.world.v.astype(dtype)}
    of_elements |= {name: given[name] for name in ("gradients", "volume")}
    order = np.argsort(effect.patch, kind="stable").astype(np.int32)
    start = np.searchsorted(effect.patch[order], np.arange(patches + 1)).astype(np.int32)
    module_in(effect.path, real).bind("measure", m, dilatation=out["dilatation"], **of_elements)()
    module_in(effect.path_of_patches, real).bind(
        "pressures", patches, projection=PROJECTIONS["clamp"], start=start, cells=order,
        volume=given["patch_volume"], bulk=given["bulk"], floor=given["patch_floor"],
        stiffness_coefficient=np.full(patches, h**2, dtype), dilatation=out["dilatation"], pressure=out["pressure"],
        weight=out["weight"],
    )()  # fmt: skip
    module_in(effect.path, real).bind(
        "elements", m, projection=PROJECTIONS["clamp"], patch=effect.patch, constants=given["constants"],
        floor=given["floor"], pressure=out["pressure"], stiffness_coefficient=np.full(m, h**2, dtype), h=h,
        clock=np.zeros(1), refused=effect.refused.copy(), corners=out["corners"], edges=out["edges"],
        areas=out["areas"], **of_elements,
    )()  # fmt: skip
    return {name: array.astype(float) for name, array in out.items()}


CASES = {
    f"{name} {size}": (law, size) for name, law in PATCHED.items() for size in ((0.1, 0.6) if law.inverts else (0.1,))
}


@pytest.mark.parametrize(("law", "size"), CASES.values(), ids=CASES.keys())
def test_single_precision_agrees(tmp_path, law, size):
    sim = patched(tmp_path, law)
    deform(sim, size, seed=2)
    single, double = in_precision(sim, "float"), in_precision(sim, "double")
    for name, expected in double.items():
        assert np.abs(single[name] - expected).max() < 1e-4 * np.abs(expected).max() > 0, name


@pytest.mark.parametrize("law", PATCHED.values(), ids=PATCHED.keys())
def test_at_rest_too(tmp_path, law):
    """At rest stretches are equal, and eigenvalues are zero."""
    sim = patched(tmp_path, law)
    single, double = in_precision(sim, "float"), in_precision(sim, "double")
    for name, of in {"edges": "edges", "corners": "edges", "weight": "weight", "areas": "areas"}.items():
        assert np.abs(single[name] - double[name]).max() < 1e-4 * np.abs(double[of]).max(), name
