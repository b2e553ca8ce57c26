# SPDX-License-Identifier: MIT
"""Bodies of every kind of elements lie on a floor: where, how far pressed together, with which force."""

import numpy as np
import pytest

from sim_server.updates.driver import Driver
from tests.contact.scenes import D, block, over
from tests.reference.quadratic_statics import face_shares

KINDS = ("linear", "patch", "smoothed", "quadratic")
SIZE, SOFT, G = (0.1, 0.06, 0.1), 2e4, 9.81  # m, Pa, m/s2


@pytest.mark.parametrize("kind", KINDS)
def test_a_column_rests_at_the_height_that_its_weight_leaves(kind):
    """Without friction and with Poisson's ratio 0: rho g H^2 / 2 E lower over its base, as any elements know."""
    table = block(
        friction=0.0, cells=(2, 2, 2) if kind == "quadratic" else (4, 3, 4), young=SOFT, poisson=0.0, elements=kind,
        at=(0, 2 * D, 0), damping=(2.0, 0.02),
    )  # fmt: skip
    sim = over(objects=[table])
    driver = Driver(sim)
    records = driver.advance(240)
    assert (records["status"] == 0).all() and np.abs(sim.world.v).max() < 1e-4
    x, height = sim.world.x[:, 1], sim.world.rest[:, 1] - sim.world.rest[:, 1].min()
    mesh = sim.world.bodies[0].mesh
    parts = [
        face_shares(mesh.rest, mesh.tets if mesh.quadratic is None else mesh.quadratic, np.abs(height - h) < 1e-9)
        for h in (0.0, SIZE[1])
    ]  # fmt: skip
    base, top = (part @ x / part.sum() for part in parts)  # means over the area
    assert x.min() > 0 and 0.7 * D < base < D
    weight = G * sim.world.mass.sum()
    sag = 1000 * G * SIZE[1] ** 2 / (2 * SOFT)
    assert SIZE[1] - (top - base) == pytest.approx(sag, rel=0.005)
    driver.advance(1)
    assert -driver.reactions[0, 0, 1] == pytest.approx(weight, rel=1e-3)
