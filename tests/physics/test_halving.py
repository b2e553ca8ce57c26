# SPDX-License-Identifier: MIT
"""`on_runaway = "halve"`: what runs away goes on by short steps, ends where small steps do; nothing else notices."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from protocol import messages_pb2 as pb
from sim_server.checkpoint.content import capture
from sim_server.errors import InputError
from sim_server.service.telemetry import Telemetry
from sim_server.simulation import Simulation
from sim_server.state.start import Start
from sim_server.updates.driver import Driver
from tests.cutting.cut_scenes import cut, made
from tests.log.test_replay_of_factors import replayed
from tests.physics.test_runaway import SCHEMES, WILD, released, wild
from tests.resets.going_on import differing, resumed
from tests.scenes import bar, scene, simulation

ONE_STEP = {name: table for name, table in SCHEMES.items() if name != "ros2"}


def crushed(on_runaway: str = "halve", **table: Any) -> Simulation:
    """A soft column under far more than it bears: it turns over, which one linearization of 50 ms does not follow."""
    effects = {"neo_hookean": {"young": 2e4, "poisson": 0.45, "inversion": "regularize"}, "rayleigh": {"mass": 1}}
    column = bar((8, 2, 2), (4, 0.5, 0.5), young=None, effects=effects | {"fixed": {"where": "X < 0.01"}})
    wanted = {"dt": 0.05, "preconditioner": "block_jacobi", "projection": "clamp", "max_iterations": 1000}
    return simulation(column, gravity=(-60, -1, 0), on_runaway=on_runaway, **(wanted | table))


def test_a_body_that_flies_apart_comes_to_rest_and_its_energy_never_rises():
    sim = released(wild(), on_runaway="halve")
    energy, halvings = [sim.potential_energy()], []
    for _ in range(120):
        sim.engine.run(1)
        (record,) = sim.engine.records()
        assert record["status"] == pb.CONVERGED
        halvings.append(int(record["halvings"]))
        energy.append(sim.potential_energy() + sim.kinetic_energy())
    assert 0 < max(halvings) <= 4 and not any(halvings[60:])
    assert max(energy) <= energy[0] and energy[-1] < 1e-4 * energy[0]
    assert np.abs(sim.world.x - sim.world.rest).max() < 0.1


def test_it_ends_where_small_steps_end():
    """Steps of 50 ms alone end frozen; with short ones in between the column hangs, long, as by steps of a fifth."""
    frozen, halved, fine = crushed("freeze"), crushed(), crushed("freeze", dt=0.01)
    for sim, steps in ((frozen, 20), (halved, 400), (fine, 2000)):
        sim.engine.run(steps)
    away, again, small = (sim.engine.records()["status"] == pb.RUNAWAY for sim in (frozen, halved, fine))
    assert away.any() and not again.any() and not small.any()
    assert np.ptp(halved.world.x[:, 0]) > 20 and np.abs(halved.world.x - fine.world.x).max() < 0.02


def test_short_steps_start_from_the_last_one():
    """The guess is of a whole step, which is several times as long."""
    sim = crushed()
    given = sim.engine_input()
    (whole,) = (x for x in given.assemble if x.name == "nodes.rotate")
    short = [x for launches in given.halving.assemble for x in launches if x.name == "nodes.rotate"]
    assert whole.arrays["guess"] is sim.system.guess.next
    assert len(short) == 4 and all(x.arrays["guess"] is sim.system.dv for x in short)


@pytest.mark.parametrize("threads", [1, 2])
def test_neighbours_are_not_disturbed(threads):
    others = [bar(name=name, young=2e4, fixed="X < 0.01", touch={"max_force": 1e3}) for name in ("before", "behind")]
    table = {"gravity": (0, -9.81, 0), "threads": threads, "on_runaway": "halve"}
    both = released(others[0], wild(), others[1], **table)
    alone = released(*others, names=(), **table)
    both.engine.run(25)
    alone.engine.run(25)
    halvings = both.engine.records()["halvings"].reshape(-1, 3)
    assert halvings[:, 1].any() and not halvings[:, [0, 2]].any()
    for name in ("before", "behind"):
        a, b = both.world.body(name).nodes, alone.world.body(name).nodes
        assert both.world.x[a].tobytes() == alone.world.x[b].tobytes()
        assert both.world.v[a].tobytes() == alone.world.v[b].tobytes()


def test_a_hand_on_a_neighbour_feels_and_does_the_same():
    calm = bar(name="calm", young=2e4, fixed="X < 0.01", touch={"max_force": 1e5})
    felt = []
    for others, wild_ones in (((wild(),), ("wild",)), ((), ())):
        sim = released(calm, *others, names=wild_ones, gravity=(0, -9.81, 0), on_runaway="halve")
        sim.touch.grab("anna", "calm", (2.0, 0.5, 0.5), 0.3, (2.3, 0.8, 0.5), 2e3, 150.0, 1e3)
        sim.engine.run(10)
        records = sim.engine.records()
        assert not others or records["halvings"].any()
        felt.append((records["work"][:: 1 + len(others)].tolist(), sim.engine.other_reactions()["force"].tolist()))
    assert felt[0] == felt[1]


def test_short_steps_that_do_not_help_leave_no_work_behind():
    """The budget is set so low that no short step is good enough; the step is then as the scheme made it."""
    column = bar((4, 2, 2), (2, 0.5, 0.5), young=2e4, fixed="X < 0.01", touch={"max_force": 1e5})
    ends = []
    for choice in ("freeze", "halve"):
        sim = simulation(column, gravity=(0, -9.81, 0), preconditioner="block_jacobi", on_runaway=choice)
        sim.touch.grab("anna", "bar", (2.0, 0.5, 0.5), 0.3, (2.3, 0.8, 0.5), 2e3, 150.0, 1e3)
        sim.engine.run(6)
        sim.engine.records()
        balance = sim.energies.balance
        balance["start"] -= float(balance["budget"][0]) + 10 * float(balance["gross"][0])
        sim.engine.run(1)
        (record,) = sim.engine.records()
        assert record["halvings"] == 0
        ends.append((float(record["work"]), int(record["iterations"])))
    assert ends[0][0] == ends[1][0] and ends[1][1] > ends[0][1]


@pytest.mark.parametrize("integrator", ONE_STEP.values(), ids=ONE_STEP)
def test_what_does_not_run_away_is_the_same_to_the_bit(integrator):
    ends = []
    for choice in ("freeze", "halve"):
        objects = [bar(name=name, young=1e5, fixed="X < 0.01") for name in "ab"]
        sim = simulation(
            *objects, gravity=(0, -9.81, 0), integrator=integrator, preconditioner="block_jacobi", on_runaway=choice
        )
        sim.engine.run(30)
        assert not sim.engine.records()["halvings"].any()
        ends.append(sim.world.x.tobytes() + sim.world.v.tobytes())
    assert ends[0] == ends[1]


@pytest.mark.parametrize("integrator", ONE_STEP.values(), ids=ONE_STEP)
def test_every_scheme_goes_on_from_short_steps(integrator):
    """By short steps where it needs them, and by those of the scheme after that."""
    sim = released(wild(), on_runaway="halve", integrator=integrator)
    start = sim.potential_energy()
    sim.engine.run(90)
    records = sim.engine.records()
    assert np.isfinite(sim.world.x).all() and (records["status"] != pb.RUNAWAY).all()
    assert sim.potential_energy() + sim.kinetic_energy() < start


@pytest.mark.parametrize("integrator", ONE_STEP.values(), ids=ONE_STEP)
def test_what_short_steps_do_not_help_is_frozen_where_the_step_began(integrator):
    """It has the energy that it had, and its budget is taken away."""
    sim = simulation(
        *(bar(name=name, young=1e4, fixed="X < 0.01") for name in ("wild", "calm")), gravity=(0, -9.81, 0),
        integrator=integrator, preconditioner="block_jacobi", on_runaway="halve",
    )  # fmt: skip
    sim.engine.run(5)
    sim.energies.balance["start"][0] = -1e9
    mine, before, statuses = sim.world.bodies[0].nodes, [], []
    for _ in range(6):
        before.append(sim.world.x[mine].copy())
        sim.engine.run(1)
        statuses.append(int(sim.engine.records()["status"][0]))
    assert pb.RUNAWAY in statuses
    np.testing.assert_array_equal(sim.world.x[mine], before[statuses.index(pb.RUNAWAY)])
    assert not sim.world.v[mine].any() and not sim.world.predictor[mine].any()


def test_a_run_is_repeated_reset_and_resumed_to_the_bit(tmp_path: Path):
    sim = crushed(preconditioner="cholesky", update="lockstep-2")
    start, driver = Start(sim), Driver(sim)
    driver.advance(9)
    data, records = capture(sim, driver, "test").to_bytes(), driver.advance(8)
    assert records["halvings"].any(), "in the middle of short steps"
    other = crushed(preconditioner="cholesky", update="lockstep-2")
    again = resumed(data, other)
    assert differing(again.advance(8), records) == []
    assert other.world.x.tobytes() == sim.world.x.tobytes()
    alone = crushed()
    start = Start(alone)
    alone.engine.run(12)
    first, x = alone.engine.records(), alone.world.x.copy()
    found = replayed(alone, first, tmp_path / "run.mcap")
    assert found.same and found.solves_compared == 12, found.lines()
    start.reset()
    alone.engine.run(12)
    np.testing.assert_array_equal(alone.world.x, x)
    np.testing.assert_array_equal(alone.engine.records()["halvings"], first["halvings"])


def test_it_is_told_once_and_counted():
    sim, found = crushed(), []
    driver = Driver(sim)
    telemetry = Telemetry(driver, SimpleNamespace(publish_status=found.append), None, patient=False)  # type: ignore[arg-type]
    lines = []
    for _ in range(4):
        records = driver.advance(6)
        lines += telemetry.warnings.halved(records)
        telemetry.summary.update(records)
    telemetry.publish_status("running")
    assert len(lines) == 1 and lines[0].startswith("object 'bar', step 7: ran away; made again by ")
    events = {e.event: e.steps for e in found[0].objects[0].events}
    assert set(events) == {"halvings"} and events["halvings"] >= 9
    assert found[0].objects[0].last.status == pb.CONVERGED


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "ros2": ({"integrator": {"scheme": "ros2"}}, "goes back to backward Euler"),
    "quasi_static": ({"integrator": {"scheme": "quasi_static"}}, "has no time step to halve"),
    "central_difference": ({"integrator": {"scheme": "central_difference"}}, "shorter substeps"),
    "budget": ({"budget_ms": 5.0}, "solver.budget_ms = 5"),
}


@pytest.mark.parametrize(("table", "said"), REFUSED.values(), ids=REFUSED)
def test_what_does_not_go_together_is_refused(table: dict[str, Any], said: str):
    with pytest.raises(ValueError, match=r'on_runaway = "halve".*' + said):
        scene(bar(fixed="X < 0.01"), on_runaway="halve", **table)


def test_devices_and_materials_that_do_not_have_it_refuse_it():
    with pytest.raises(InputError, match=r"solver\.on_runaway = 'halve': must be one of 'freeze', 'go_on' on a GPU"):
        scene(bar(), on_runaway="halve").check_device("gpu")
    effects = {"corotational": {"young": 1e5, "poisson": 0.3}, "prony": {"terms": [{"g": 0.5, "tau": 0.1}]}}
    with pytest.raises(InputError, match="with the effect prony, whose memory advances by whole steps"):
        simulation(bar(young=None, effects=effects), on_runaway="halve")


def test_a_body_that_was_cut_and_one_that_is_held_go_on():
    """Both are far out of shape; the hand comes to hold the tip as it holds that of a body that never was."""
    table = {"preconditioner": "block_jacobi", "tolerance": 1e-8, "max_iterations": 3000, "on_runaway": "halve"}
    sim = made("neo_hookean", solver=table)
    cut(sim, "X > 0.8 and X < 1.2 and Y > 0.25")
    sim.engine.run(3)
    sim.world.x[:], sim.world.v[:] = sim.world.rest * [4.5, 1, 1], 0
    sim.engine.records()
    sim.engine.run(30)
    records = sim.engine.records()
    assert records["halvings"].any() and (records["status"] == pb.CONVERGED).all()
    ends = []
    for names, tip in (((), 2.0), (("wild",), 6.0)):
        held = bar((4, 2, 2), (2, 0.5, 0.5), name="wild", young=None, effects=WILD | {"touch": {"max_force": 1e5}})
        sim = released(held, names=names, on_runaway="halve")
        sim.touch.grab("anna", "wild", (tip, 0.5, 0.5), 0.0, (2.3, 0.8, 0.5), 1e5, 1e5, 1e3)
        sim.engine.run(200)
        ends.append((sim.world.x.copy(), sim.engine.records()["halvings"].any()))
    assert ends[1][1] and not ends[0][1]
    np.testing.assert_allclose(ends[0][0], ends[1][0], atol=2e-3)


def test_a_law_that_is_not_defined_inside_out_is_kept_within_it():
    """Without, elements turn over in every other step, and the body goes back."""
    strict = {"neo_hookean": {"young": 1e6, "poisson": 0.45}, "fixed": WILD["fixed"]}
    body = bar((4, 2, 2), (2, 0.5, 0.5), name="wild", young=None, effects=strict)
    statuses = {}
    for choice in ("freeze", "halve"):
        sim = released(body, on_runaway=choice)
        sim.engine.run(30)
        statuses[choice] = set(sim.engine.records()["status"].tolist())
    assert pb.NOT_FINITE in statuses["freeze"] and statuses["halve"] == {pb.CONVERGED}
