# SPDX-License-Identifier: MIT
"""Kernel texts built with real = float agree with double precision to about 1e-5."""

import numpy as np
import pytest

from tests.physics.test_forces import solid_bar, stir
from tests.scenes import elastic, solid
from tests.texts import module_in


def in_precision(real: str, sim) -> dict[str, np.ndarray]:
    """Results of the elements' kernels in the present state, in float64 for comparison."""
    dtype, e, w, s = np.dtype("f8" if real == "double" else "f4"), elastic(sim), sim.world, sim.system
    m, stencil = len(e.elements), s.stencils[0]
    x, v, gradients, lame = (a.astype(dtype) for a in (w.x, w.v, e.gradients, e.lame))
    out = {
        "quaternion": np.zeros((m, 4), dtype), "scaled_gradients": np.zeros((m, 4, 4), dtype),
        "nodal_impulse": np.zeros((m, 4, 3), dtype),
        "energy": np.zeros(m, dtype), "sums": np.zeros(s.sums.shape, dtype), "b": np.zeros((w.nodes, 3), dtype),
        "block": np.zeros((w.nodes, 6), dtype), "mean": np.zeros((w.nodes, 10), dtype),
    }  # fmt: skip
    corotational = module_in("effects/corotational.cu", real)
    corotational.bind(
        "elements", m, tets=e.elements, x=x, v=v, gradients=gradients, lame=lame,
        stiffness_coefficient=np.full(m, w.dt**2, dtype), h=w.dt, quaternion=out["quaternion"],
        scaled_gradients=out["scaled_gradients"], nodal_impulse=out["nodal_impulse"],
    )()  # fmt: skip
    corotational.bind("energy", m, tets=e.elements, x=x, gradients=gradients, lame=lame, energy=out["energy"])()
    module_in("effects/corotational_blocks.cu", real).bind(
        "blocks", len(s.row), accumulate=0, start=stencil.pair_start, pairs=stencil.pairs,
        scaled_gradients=out["scaled_gradients"], sums=out["sums"],
    )()  # fmt: skip
    module_in("effects/corotational_nodes.cu", real).bind(
        "gather", w.nodes, start=stencil.corner_start, corners=stencil.corners, nodal_impulse=out["nodal_impulse"],
        scaled_gradients=out["scaled_gradients"], quaternion=out["quaternion"], b=out["b"], block=out["block"],
        mean=out["mean"],
    )()  # fmt: skip
    sign = np.sign(out["quaternion"][:, :1])  # q and -q are one rotation
    out["quaternion"] *= np.where(sign == 0, 1, sign)
    return {name: array.astype(float) for name, array in out.items()}


@pytest.mark.parametrize("size", [0.02, 0.1])
def test_single_precision_agrees(tmp_path, size):
    sim = solid_bar(tmp_path)
    stir(sim, size)
    single, double = in_precision("float", sim), in_precision("double", sim)
    for name, expected in double.items():
        assert np.abs(single[name] - expected).max() < 1e-5 * np.abs(expected).max(), name


@pytest.mark.parametrize(("real", "bound"), [("float", 3e-6), ("double", 1e-13)])
def test_how_far_a_and_b_are_from_the_reference(tmp_path, real, bound):
    """Relative to the largest entry: what an element's arithmetic in float32 costs (`precision` of the solver)."""
    sim = solid_bar(tmp_path)
    stir(sim, 0.05)
    reference, found, s = solid(sim), in_precision(real, sim), sim.system
    K = (reference.matrix() - np.diag(np.repeat(reference.mass, 3))).reshape(sim.world.nodes, 3, sim.world.nodes, 3)
    node = np.arange(sim.world.nodes)
    pairs = {
        "sums": K[s.row, :, s.column, :], "block": K[node, :, node, :][:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]],
        "b": reference.right_side(),
    }  # fmt: skip
    for name, expected in pairs.items():
        assert np.abs(found[name] - expected).max() < bound * np.abs(expected).max(), name


def test_double_precision_is_what_a_step_uses(tmp_path):
    sim = solid_bar(tmp_path)
    stir(sim, 0.1)
    sim.engine.assemble()
    found = in_precision("double", sim)
    assert np.array_equal(found["b"], sim.system.b)
    assert np.array_equal(found["sums"], sim.system.sums)
    assert np.array_equal(found["block"], sim.system.block)
    assert found["energy"].sum() == sim.potential_energy()
