# SPDX-License-Identifier: MIT
"""J <= 0 in laws with powers or a logarithm of J: the solve ends, the run does not, and the element is named."""

import numpy as np
import pytest

from protocol.messages_pb2 import SolveStatus
from sim_server.service.step_warnings import not_finite_lines
from sim_server.updates.driver import Driver
from tests.physics.laws import LAWS, Law, determinants, forces, law_bar, stiffness

REFUSING = {name: law for name, law in LAWS.items() if not law.inverts}
refusing = pytest.mark.parametrize("law", REFUSING.values(), ids=REFUSING.keys())


def pushed_through(law: Law, **scene):
    """A bar with one element just turned over, by its corner at (1, 1, 1) of the first cell."""
    sim = law_bar(law, cells=(2, 1, 1), size=(2, 1, 1), **scene)
    corner = int(np.argmin(np.abs(sim.world.rest - [0, 1, 1]).sum(axis=1)))
    sim.world.x[corner] += [1.2, -0.3, -0.2]
    bad = np.flatnonzero(determinants(sim) <= 0)
    assert 0 < len(bad) < 12
    return sim, sorted(sim.effects[law.name].number[bad])


@refusing
def test_the_element_is_named_and_the_run_goes_on(law):
    sim, bad = pushed_through(law)
    sim.world.v[:, 1] = 0.25
    x = sim.world.x.copy()
    records = Driver(sim).advance(3)
    assert (records["status"] == SolveStatus.NOT_FINITE).all() and (records["bad_node"] >= 0).all()
    assert not sim.world.v.any()
    np.testing.assert_allclose(sim.world.x - x, np.tile([0, -0.005, 0], (len(x), 1)), atol=1e-14)  # a step back, once
    assert [r.element for r in sim.refusals()] == bad
    first = sim.refusals()[0]
    assert (first.effect, first.body, first.time) == (law.name, 0, 0.0)
    expected = determinants(sim)[list(sim.effects[law.name].number).index(first.element)]
    assert pytest.approx(expected, rel=1e-12) == first.J
    lines = not_finite_lines(sim, records, set())
    assert lines == [
        f"object 'bar', step 1: element {bad[0]} has J = {expected:.3g}, which {law.name} does not define; "
        "it goes back to where the step before began and rests there"
    ]


def thrown_together(law: Law, speed: float = 60.0, **scene):
    """A bar whose ends fly at each other so fast that it is pressed through itself, and its driver."""
    sim = law_bar(law, cells=(4, 2, 2), size=(2, 1, 1), damping=(2.0, 0.01), dt=0.01, **scene)
    sim.world.v[:, 0] = -speed * (sim.world.x[:, 0] - 1.0) * sim.world.free
    return sim, Driver(sim)


@pytest.mark.parametrize("fixed", [None, "X < 0.01"], ids=["free", "held"])
@pytest.mark.parametrize("scheme", ["backward_euler", "newmark", "bdf2", "generalized_alpha", "ros2"])
def test_a_body_pressed_through_itself_is_back_where_the_step_before_began(scheme, fixed):
    sim, driver = thrown_together(LAWS["neo_hookean"], integrator={"scheme": scheme}, fixed=fixed)
    x = [sim.world.x.copy()]
    while driver.advance(1)["status"][0] == SolveStatus.CONVERGED:
        x.append(sim.world.x.copy())
    assert len(x) > 2, "it flew for a while"
    np.testing.assert_allclose(sim.world.x, x[-2], atol=1e-13)
    assert not sim.world.v.any() and determinants(sim).min() > 0
    assert (driver.advance(1)["status"] == SolveStatus.CONVERGED).all() and sim.world.v.any()


@refusing
def test_it_recovers_and_no_energy_comes_in(law):
    sim, driver = thrown_together(law, 120.0 if law.name == "veronda_westmann" else 60.0)  # it stiffens exponentially
    energy, records = [sim.potential_energy() + sim.kinetic_energy()], []
    for _ in range(60):
        records.append(driver.advance(1))
        energy.append(sim.potential_energy() + sim.kinetic_energy())
    status = np.concatenate(records)["status"]
    assert 0 < (status == SolveStatus.NOT_FINITE).sum() < 5
    assert (status[20:] == SolveStatus.CONVERGED).all()
    defined = np.array(energy)[np.isfinite(energy)]
    assert (np.diff(defined) <= 1e-9 * energy[0]).all()
    assert determinants(sim).min() > 0.5


@refusing
def test_the_matrix_stays_finite_and_the_energy_is_no_number(law):
    sim, _ = pushed_through(law)
    assert np.isfinite(stiffness(sim)).all()
    assert np.linalg.eigvalsh(stiffness(sim))[0] > -1e-9
    assert np.isnan(sim.potential_energy())


def test_other_bodies_and_later_times():
    """A body that is pressed through itself while the run lasts; its neighbour takes no notice."""
    law = LAWS["neo_hookean"]
    sim, _ = pushed_through(law)
    sim.world.x[:] = sim.world.rest
    assert (Driver(sim).advance(4)["status"] == SolveStatus.CONVERGED).all() and sim.refusals() == []
    sim.world.x[0] += [1.5, 0.3, 0.2]
    assert Driver(sim).advance(1)["status"][0] == SolveStatus.NOT_FINITE
    assert [r.time for r in sim.refusals()] == pytest.approx([4 * 0.02] * len(sim.refusals())) and sim.refusals()


@pytest.mark.parametrize("name", ["neo_hookean, regularized", "mooney_rivlin, regularized"])
def test_regularized_laws_bring_the_element_back(name):
    sim, _ = pushed_through(LAWS[name], damping=(2.0, 0.0), dt=0.01)
    records = Driver(sim).advance(300)
    assert (records["status"] == SolveStatus.CONVERGED).all() and sim.refusals() == []
    assert determinants(sim).min() > 0.5
    rest = forces(sim)
    assert np.abs(rest).max() < 1e-2 * 3e4


def test_the_element_named_is_that_of_the_step():
    """One that was refused before and came back (as in a line search) is not the one."""
    sim, bad = pushed_through(LAWS["neo_hookean"])
    pressed = sim.world.x.copy()
    Driver(sim).advance(1)
    assert [r.element for r in sim.refusals()] == bad
    sim.world.x[:] = sim.world.rest
    Driver(sim).advance(2)
    other = int(np.argmax(pressed[:, 0] * (pressed == sim.world.rest).all(axis=1)))
    sim.world.x[other] -= [2.5, 0.2, 0.1]
    records = Driver(sim).advance(1)
    (line,) = not_finite_lines(sim, records, set())
    number = int(line.split("element ")[1].split()[0])
    assert number not in bad and {r.element: r.time for r in sim.refusals()}[number] == pytest.approx(3 * 0.02)
