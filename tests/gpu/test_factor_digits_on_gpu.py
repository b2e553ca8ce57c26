# SPDX-License-Identifier: MIT
"""Inverses of factors get as many binary digits on a GPU as the factors need, while steps run."""

import numpy as np
import pytest

from sim_server.checkpoint.content import capture
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.hard_cases.case import BAR, GRAVITY, young
from tests.resets.going_on import differing, resumed

pytestmark = pytest.mark.gpu
SIDE_BY_SIDE = young(("X < 0.5", 1e10), ("true", 1e4))
INCOMPRESSIBLE = "object.bar.effects.corotational.poisson=0.4999"


def made(*overrides: str) -> tuple[Simulation, Driver]:
    sim = Simulation.load(BAR, [GRAVITY, *overrides], device="gpu")
    return sim, Driver(sim)


def planes(sim: Simulation) -> int:
    """float16 numbers per entry of the inverse in use."""
    sim.engine.settle_factors()
    return int(sim.engine.solver.bodies["planes"][0])


@pytest.mark.parametrize("precision", ["float64", "mixed", "float32"])
@pytest.mark.parametrize("law", [SIDE_BY_SIDE, INCOMPRESSIBLE], ids=["side by side", "incompressible"])
def test_where_11_do_not_suffice_there_are_22(law: str, precision: str) -> None:
    found = {}
    for given in ("auto", "float16", "float32"):
        sim, driver = made(law, f"solver.precision={precision}", f"solver.factor_precision={given}")
        driver.advance(20)  # the first ten have no factor
        records = driver.advance(60)
        found[given] = records["iterations"].mean()
        assert planes(sim) == (1 if given == "float16" else 2)
        assert given == "float16" or not records["fallbacks"].any()
    assert found["auto"] == found["float32"] < 0.6 * found["float16"]


def test_a_usual_body_keeps_11_and_its_bits() -> None:
    (one, driver), (other, second) = made(), made("solver.factor_precision=float16")
    assert differing(driver.advance(40), second.advance(40)) == []
    assert planes(one) == planes(other) == 1
    np.testing.assert_array_equal(one.fetch().x, other.fetch().x)


def test_digits_come_and_go_with_a_parameter_and_a_run_goes_on_to_the_bit() -> None:
    """From a file saved with either; a second run of the same is the same."""
    courses = []
    for _ in range(2):
        sim, driver = made("solver.update=every-3")
        saved, records, digits = [], [], []
        for poisson in (0.45, 0.4999, 0.45):
            sim.parameters.set({"bar.corotational.poisson": repr(poisson)})
            driver.advance(10)
            digits.append(planes(sim))
            saved.append(capture(sim, driver, "test").to_bytes())
            records.append(driver.advance(8))
        assert digits == [1, 2, 1]
        courses.append((records, sim.fetch().x.copy()))
    for a, b in zip(courses[0][0], courses[1][0], strict=True):
        assert differing(a, b) == []
    np.testing.assert_array_equal(courses[0][1], courses[1][1])
    for data, poisson, expected in zip(saved, (0.45, 0.4999, 0.45), courses[1][0], strict=True):
        sim, _ = made("solver.update=every-3")
        again = resumed(data, sim)
        assert differing(again.advance(8), expected) == [], poisson
