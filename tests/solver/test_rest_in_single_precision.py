# SPDX-License-Identifier: MIT
"""Bodies at rest where a step is in single precision, as on a GPU in float32: there a load may be below the rounding of
the forces at every node, and still bend the body."""

import numpy as np

from tests.scenes import bar, simulation
from tests.support.single_steps import SingleSteps


def nearly_incompressible() -> SingleSteps:
    """A bar held at one end, before its first step; its weight is below what its forces are known to."""
    beam = bar((6, 2, 2), young=1e6, poisson=0.4999, fixed="X < 0.01", damping=(5.0, 0.02))
    steps = SingleSteps(simulation(beam, gravity=(0, -9.81, 0)))
    steps.step()
    assert abs(steps.of(steps.sim.system.b)).max() < rounding(steps)
    return steps


def rounding(steps: SingleSteps) -> float:
    """Of the largest component of b, as kernels/nodes.cu takes it."""
    s = steps.sim.system
    stiffness = steps.of(s.block)[:, [0, 3, 5]].mean(axis=1)
    return float((4 * 1.2e-7 * stiffness * s.inverse_time * s.extent).max())


def test_a_load_below_the_rounding_of_forces_bends_the_body_and_then_it_rests():
    steps = nearly_incompressible()
    x, exact = steps.of(steps.sim.world.x), SingleSteps(steps.sim, "double")
    begin = exact.of(steps.sim.world.x).copy()
    solved = [steps.step() for _ in range(300)]
    for _ in range(301):
        exact.step()
    way = steps.sim.world.x - begin
    assert abs(way).max() > 1e-2
    assert abs(x - begin - way).max() < 0.03 * abs(way).max()
    assert all(solved[:50]) and not any(solved[-20:])


def test_at_rest_a_load_that_changes_by_less_than_rounding_is_solved_for():
    steps = nearly_incompressible()
    x = steps.of(steps.sim.world.x)
    for _ in range(300):
        steps.step()
    before = x.copy()
    assert not steps.step() and np.array_equal(x, before)
    steps.launch("gravity.gravity").arrays["g"][:] *= np.float32(0.9)
    assert steps.step()
    for _ in range(100):
        steps.step()
    assert abs(x - before).max() > 1e-3
