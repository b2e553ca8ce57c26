# SPDX-License-Identifier: MIT
"""Bodies that are split along faces, beside the CPU's. Runs where there is a GPU: -m gpu."""

from pathlib import Path

import numpy as np
import pytest

from protocol import messages_pb2 as pb
from sim_server.checkpoint.content import capture, restore, restore_driver, saved_factors
from sim_server.checkpoint.file import from_bytes
from sim_server.errors import InputError
from sim_server.parameters import BadParameter
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.state.start import Start
from sim_server.updates.driver import Driver
from tests.cutting.cut_scenes import table
from tests.cutting.split_scenes import FINE, HALVES, SCHEMES, SLIT, SPARE, SPLIT_LAWS, of_scheme, split
from tests.system.test_cuts_of_a_server import split_about
from tests.system.test_replay_of_a_server import messages, recorded, replayed

pytestmark = pytest.mark.gpu
FREE = "Y > 0.25"


def made(law: str = "corotational", device: str = "gpu", **keys) -> Simulation:
    return Simulation(Scene.model_validate(table(law, **keys), context={"folder": "."}), device)


def device_array(sim, host):
    return sim.world.backend.fetch(host)


@pytest.mark.parametrize(
    ("law", "scheme"),
    [*((law, "backward_euler") for law in SPLIT_LAWS),
     *((law, scheme) for law in ("corotational", "neo_hookean") for scheme in SCHEMES)],
)  # fmt: skip
def test_a_body_that_is_split_in_motion_goes_on_as_on_a_cpu(law, scheme):
    """A slit first, with a corner in it, then all through; the pattern of A and what is gathered are others."""
    keys = {} if scheme == "backward_euler" else of_scheme(scheme)
    ends = []
    for device in ("gpu", "cpu"):
        sim = made(law, device, own=SPARE, **keys)
        sim.engine.run(3)
        split(sim, SLIT)
        sim.engine.run(6)
        split(sim, HALVES)
        sim.engine.run(6)
        ends.append((sim.fetch().x.copy(), sim.world.v.copy(), device_array(sim, sim.world.mass).copy()))
        assert (sim.engine.records()["status"] == pb.CONVERGED).all()
        assert device_array(sim, sim.cutting.at_rest).sum() < 60 - 9
    bound = 2e-4 if scheme == "central_difference" else 1e-6  # substeps come in fours on a GPU
    np.testing.assert_allclose(ends[0][0], ends[1][0], atol=bound)
    np.testing.assert_allclose(ends[0][1], ends[1][1], atol=100 * bound)
    np.testing.assert_allclose(ends[0][2], ends[1][2], rtol=1e-14)


@pytest.mark.parametrize(
    "keys",
    [
        {"solver": {"preconditioner": "none"}},
        {"solver": {"preconditioner": "jacobi"}},
        {"solver": {"preconditioner": "block_jacobi"}, "integrator": {"linearizations": 3}},
        {"solver": {}, "integrator": {"scheme": "newmark", "linearizations": 4}},
        {"solver": {}, "accuracy": {"position": 1e-7}},
    ],
    ids=["none", "jacobi", "newton", "newmark", "accuracy"],
)
def test_every_solver_goes_on_after_a_split_in_motion(keys):
    keys = keys | {"solver": {"tolerance": 1e-11, "max_iterations": 5000} | keys["solver"]}
    ends = []
    for device in ("gpu", "cpu"):
        sim = made("corotational", device, own=SPARE, **keys)
        sim.engine.run(6)
        split(sim, SLIT)
        sim.engine.run(8)
        ends.append(sim.fetch().x.copy())
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)


@pytest.mark.parametrize("precision", ["mixed", "float32"])
def test_other_precisions_split_too(precision):
    solver = {"precision": precision, "tolerance": 1e-5, "max_iterations": 3000}
    ends = []
    for given in (solver, {"tolerance": 1e-10, "max_iterations": 3000}):
        sim = made(own=SPARE, solver=given)
        sim.engine.run(3)
        split(sim, SLIT)
        sim.engine.run(10)
        ends.append(sim.fetch().x.copy())
    np.testing.assert_allclose(ends[0], ends[1], atol=2e-3)


def sums(sim):
    """Mass, momentum and angular momentum, by what the device has."""
    there = device_array(sim, sim.cutting.at_rest) == 0
    m, x, v = device_array(sim, sim.world.mass)[there, None], sim.fetch().x[there], sim.world.v[there]
    return np.concatenate([m.sum(axis=0), (m * v).sum(axis=0), (m * np.cross(x, v)).sum(axis=0)])


@pytest.mark.parametrize("scheme", ["backward_euler", *SCHEMES])
def test_mass_and_momenta_are_kept_to_rounding(scheme):
    solver = {"tolerance": 1e-12} if scheme != "central_difference" else {"preconditioner": "none"}
    keys = {"integrator": {"scheme": scheme}, "solver": solver}
    sim = made(fixed=False, own=SPARE | {"rayleigh": {}}, effects={}, **keys)
    world = sim.world
    sim.fetch()
    world.v[:] = np.cross([0.0, 1.0, 3.0], world.x - world.x.mean(axis=0)) + np.array([1.0, 2.0, 0.0])
    world.backend.push(world.v)
    sim.engine.run(3)
    for where in (HALVES, FREE):
        before = sums(sim)
        split(sim, where)
        sim.engine.take_changes()
        np.testing.assert_allclose(sums(sim), before, rtol=1e-13, atol=1e-11)
        sim.engine.run(5)
        np.testing.assert_allclose(sums(sim)[:4], before[:4], rtol=1e-9, atol=1e-8)
    assert (sim.engine.records()["status"] == pb.CONVERGED).all()


def test_a_split_is_taken_between_batches_of_many_steps():
    """The answer does not depend on how many steps are launched together before it."""
    found = []
    for counts in ((40, 7), (20, 13, 7, 7)):
        sim = made(own=SPARE)
        for count in counts[:-1]:
            sim.engine.run(count)
        split(sim, SLIT)
        sim.engine.run(counts[-1])
        found.append(sim.fetch().x.copy())
    np.testing.assert_array_equal(*found)


def test_two_splits_of_which_the_loop_takes_the_second_one_alone():
    one, other = made(own=SPARE), made(own=SPARE)
    for each in (one, other):
        each.engine.run(3)
        split(each, SLIT)
        if each is other:
            each.engine.take_changes()
        split(each, HALVES)
        each.engine.run(5)
    np.testing.assert_array_equal(one.fetch().x, other.fetch().x)


def test_a_part_that_comes_apart_falls_freely():
    sim = made(own=SPARE | {"rayleigh": {}}, solver={"tolerance": 1e-12, "max_iterations": 3000})
    found = split(sim, HALVES)
    far = np.unique(found.tets[sim.world.bodies[0].centroids[:, 0] > 1])
    start = sim.world.bodies[0].mesh.rest[found.root]
    sim.engine.run(50)
    m, x = device_array(sim, sim.world.mass)[far], sim.fetch().x[far]
    np.testing.assert_allclose((m @ (x - start[far])) / m.sum(), [0, -9.81 * 0.02**2 * 50 * 51 / 2, 0], atol=1e-9)


@pytest.mark.parametrize("update", ["every-4", "lockstep-3"])
def test_factors_of_the_split_body_come_and_older_ones_are_not_used(update):
    solver = {"preconditioner": "cholesky", "update": update, "tolerance": 1e-6}
    sim = made(mesh=FINE, own={"cutting": {"spare": 90}}, solver=solver)
    driver = Driver(sim)
    before = driver.advance(9)
    assert before["factor_step"][-1] >= 0
    split(sim, SLIT)
    records = driver.advance(16)
    assert (records["status"] == pb.CONVERGED).all() and records["fallbacks"].sum() == 0
    used = records["factor_step"]
    assert ((used == -1) | (used >= 9)).all(), "of matrices from before none is used"
    assert used[-1] > 9 and records["iterations"][-1] <= 8 < records["iterations"][used < 0].max(initial=9)


def test_matrices_are_copied_with_the_pattern_of_their_step():
    """As the CPU has them, of two bodies one behind the other, of which the first one is split."""
    found = []
    for device in ("gpu", "cpu"):
        given = table("corotational", own=SPARE)
        other = table("corotational", own={})["object"][0] | {"name": "other"}
        sim = Simulation(Scene.model_validate(given | {"object": [given["object"][0], other]}), device)
        system, copies = sim.system, []
        for where in (None, SLIT, HALVES):
            if where:
                split(sim, where)
            targets = [np.zeros((system.most_blocks(b.first, b.last), 3, 3)) for b in sim.world.bodies]
            for k, target in enumerate(targets):
                sim.engine.request_matrix(k, target)
            sim.engine.run(2)
            for k, (body, target) in enumerate(zip(sim.world.bodies, targets, strict=True)):
                assert sim.engine.matrix_step(k) >= 0
                blocks = system.body_pattern(body.first, body.last)[1]
                copies.append(target[: len(blocks)].copy())
        found.append(copies)
    for ours, theirs in zip(*found, strict=True):
        assert ours.shape == theirs.shape and np.abs(ours).max() > 1
        np.testing.assert_allclose(ours, theirs, atol=1e-5 * np.abs(theirs).max())


def test_a_split_body_is_repeated_to_the_bit_and_a_reset_makes_it_whole():
    sim, twin = made(own=SPARE), made(own=SPARE)
    start = Start(sim)
    for each in (sim, twin):
        each.engine.run(4)
        split(each, SLIT)
        each.engine.run(4)
        split(each, HALVES)
        each.engine.run(4)
    np.testing.assert_array_equal(sim.fetch().x, twin.fetch().x)
    start.reset()
    assert sim.parameters.changed == {}
    whole = made(own=SPARE)
    for each in (sim, whole):
        each.engine.run(6)
    np.testing.assert_array_equal(sim.fetch().x, whole.fetch().x)
    for each in (sim, whole):
        split(each, HALVES)
        each.engine.run(6)
    np.testing.assert_array_equal(sim.fetch().x, whole.fetch().x)


@pytest.mark.parametrize("scheme", ["backward_euler", "newmark", "bdf2"])
@pytest.mark.parametrize("update", ["every-3", "lockstep-2"])
def test_a_checkpoint_of_a_split_body_goes_on_to_the_bit(update, scheme):
    """Also one that was saved while the factor that the body has is too old to be used."""
    keys = {"own": {"cutting": {"spare": 90}}, "mesh": FINE, "solver": {"tolerance": 1e-8, "update": update}}
    keys["integrator"] = {"scheme": scheme}
    for steps in (1, 5):
        driver = Driver(made(**keys))
        driver.advance(4)
        split(driver.simulation, SLIT)
        driver.advance(steps)
        saved = from_bytes(capture(driver.simulation, driver, "test").to_bytes())
        again = Driver(made(**keys))
        manifest = restore(again.simulation, saved)
        restore_driver(again, manifest, saved_factors(again.simulation, saved, manifest))
        records = []
        for each in (driver, again):
            each.advance(6)
            split(each.simulation, HALVES)
            records.append(each.advance(6))
        if update == "every-3":  # a factor in flight while an object is split is lost
            np.testing.assert_array_equal(driver.simulation.fetch().x, again.simulation.fetch().x)
        np.testing.assert_allclose(driver.simulation.fetch().x, again.simulation.fetch().x, atol=1e-5)
        assert all((r["status"] == pb.CONVERGED).all() for r in records)


def test_elements_are_removed_from_a_split_body():
    ends = []
    for device in ("gpu", "cpu"):
        sim = made("corotational", device, own=SPARE)
        split(sim, HALVES)
        sim.engine.run(2)
        gone = np.flatnonzero(sim.world.bodies[0].centroids[:, 0] > 1.74)
        sim.parameters.set({"bar.cutting.removed": f'"{" ".join(map(str, gone))}"'})
        sim.engine.run(10)
        ends.append((sim.fetch().x.copy(), device_array(sim, sim.cutting.at_rest).copy()))
    np.testing.assert_array_equal(ends[0][1], ends[1][1])
    np.testing.assert_allclose(ends[0][0], ends[1][0], atol=1e-6)


def test_splits_of_a_server_are_repeated_bit_for_bit(tmp_path: Path):
    log = recorded(tmp_path, "", "cholesky", "--device", "gpu", touch=split_about, effects="cutting = { spare = 60 }\n")
    found = messages(log, "parameters")
    assert sum(p.key.endswith("cutting.opened") for m in found for p in m.parameters) == 2
    assert replayed(log, 0, timeout=240)["same"]


def test_too_few_spare_nodes_are_refused_and_nothing_changes():
    sim, twin = made(own={"cutting": {"spare": 8}}), made(own={"cutting": {"spare": 8}})
    with pytest.raises(BadParameter, match="it needs 9 more spare nodes"):
        split(sim, HALVES)
    for each in (sim, twin):
        each.engine.run(3)
    np.testing.assert_array_equal(sim.fetch().x, twin.fetch().x)


@pytest.mark.parametrize("scheme", ["ros2", "quasi_static"])
def test_other_schemes_are_refused(scheme):
    with pytest.raises(InputError, match=f"ros2|{scheme}"):
        made(own=SPARE, integrator={"scheme": scheme})
