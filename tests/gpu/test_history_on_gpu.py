# SPDX-License-Identifier: MIT
"""Materials that remember, beside the CPU's. Runs where there is a GPU: -m gpu."""

import numpy as np
import pytest

from tests.resets.state_scenes import made

pytestmark = pytest.mark.gpu
REMEMBERING = ("prony", "prony, friction, bdf2", "plasticity", "damage", "poroelasticity")


@pytest.mark.parametrize("name", [n for n in REMEMBERING if "friction" not in n])
@pytest.mark.parametrize("precision", ["float64", "mixed"])
def test_they_move_as_on_a_cpu(name, precision):
    """Their memory comes to the same, too."""
    ends = []
    for device, given in (("gpu", precision), ("cpu", "float64")):
        sim = made(name, device, preconditioner="block_jacobi", tolerance=1e-9, precision=given)
        sim.engine.run(25)
        ends.append(sim.fetch().x.copy())
    size = np.ptp(ends[1], axis=0).max()
    bound = 1e-6 if precision == "float64" else 1e-3
    np.testing.assert_allclose(ends[0], ends[1], atol=bound * size)
