# SPDX-License-Identifier: MIT
"""What is left alone comes to rest: under a load beyond the stiffness, near the limit of friction, in a pile."""

import numpy as np
import pytest

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.contact.scenes import D, block, floor, over


def pile(count: int) -> Simulation:
    """Soft blocks that fall into a box, four a layer, each turned by some degrees."""
    random, size, distance = np.random.default_rng(1), (0.1, 0.06, 0.1), 0.13
    blocks = []
    for k in range(count):
        column, row, layer = k % 2, k // 2 % 2, k // 4
        aside, turn = 0.005 * random.standard_normal(2), 12 * random.uniform(-1, 1, 3)
        at = (distance * column + aside[0], 0.03 + distance * layer, distance * row + aside[1])
        made = block(cells=(3, 2, 3), size=size, name=f"b{k}", at=at, rotate=turn.tolist(), young=2e4)
        made["effects"]["rayleigh"] = {"stiffness": 0.01}
        blocks.append(made)
    walls = [
        {"name": name, "shape": "plane", "pose": {"rotate": turn, "translate": at}}
        for name, turn, at in (
            ("left", (0, 0, -90), (-0.04, 0, 0)), ("right", (0, 0, 90), (0.27, 0, 0)),
            ("back", (90, 0, 0), (0, 0, -0.04)), ("front", (-90, 0, 0), (0, 0, 0.27)),
        )
    ]  # fmt: skip
    return over(floor(), *walls, objects=blocks)


def test_a_pile_whose_contacts_bear_more_than_their_stiffness_settles():
    """Blocks that jam press single vertices by more than a contact at its thickness carries."""
    sim = pile(16)
    driver = Driver(sim)
    driver.advance(165)
    records, weight = driver.advance(10), sim.world.mass.sum() * 9.81
    on_floor = -driver.reactions.reshape(10, 16, 5, 6)[:, :, :, 1].sum(axis=(1, 2))
    assert not records["status"].any() and not records["clipped"].any()
    assert records["passes"].max() <= 2
    assert records["iterations"].max() <= 20
    assert abs(sim.world.v).max() <= 0.01
    assert np.allclose(on_floor, weight, rtol=0.01)  # of floor and walls
    hardening = sim.contact.contact_input().hardening
    assert set(np.unique(hardening)) == {1.0, 10.0}


def test_a_load_beyond_the_stiffness_rests_on_a_floor():
    """A hundredth of the usual stiffness: the block would lie deeper than the thickness."""
    sim = over(objects=[block(at=(0, 0.01, 0))], contact={"thickness": D, "stiffness": 0.01})
    driver = Driver(sim)
    driver.advance(60)
    records = driver.advance(10)
    weight = sim.world.mass.sum() * 9.81
    assert abs(sim.world.v).max() <= 1e-6
    assert records["passes"].max() <= 1
    assert -driver.reactions[:, 0, 1] == pytest.approx(weight, rel=1e-4)
    assert 0 < sim.world.x[:, 1].min() < D


def test_a_stiffened_contact_softens_when_the_load_goes():
    sim = over(objects=[block(at=(0, 0.01, 0))], contact={"thickness": D, "stiffness": 0.01})
    driver = Driver(sim)
    driver.advance(60)
    hardening = sim.contact.contact_input().hardening
    assert hardening.max() == 10
    sim.world.v[:, 1] += 1.0
    driver.advance(2)
    assert (hardening == 1).all()


@pytest.mark.parametrize("below", [0.1, 0.3])
def test_a_block_near_the_limit_of_friction_comes_to_rest(below):
    """Tenths of a degree below it the block stops, and its steps become cheap."""
    slope = np.arctan(0.5) - np.radians(below)
    gravity = (9.81 * np.sin(slope), -9.81 * np.cos(slope), 0)
    sim = over(floor(0.5), objects=[block(0.5, (10, 5, 10))], gravity=gravity)
    driver = Driver(sim)
    driver.advance(120)
    records = driver.advance(40)
    assert abs(sim.world.v).max() <= 5e-8
    assert records["passes"].max() <= 1
    assert records["iterations"].mean() <= 12  # 6 to 10, by the rounding of the machine


def test_passes_bounds_steps_at_rest_too():
    slope = np.arctan(0.5) - np.radians(0.1)
    gravity = (9.81 * np.sin(slope), -9.81 * np.cos(slope), 0)
    sim = over(objects=[block(0.5, (10, 5, 10))], gravity=gravity, contact={"thickness": D, "passes": 1})
    records = Driver(sim).advance(60)
    assert records["passes"].max() <= 2  # one, and the last one
