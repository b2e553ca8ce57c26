# SPDX-License-Identifier: MIT
"""Hyperelastic bodies in patches in scenes: locking, schemes, inverted elements, energies, workers, parameters."""

import numpy as np
import pytest

from protocol.messages_pb2 import SolveStatus
from sim_server.mesh import Mesh
from sim_server.recording import messages
from sim_server.simulation import Simulation
from sim_server.state.start import Start
from sim_server.updates.driver import Driver
from sim_server.updates.worker_assembly import Assembly
from tests.physics.laws import LAWS, determinants, elements, law_bar
from tests.physics.test_hyperelastic_patches import every_law
from tests.physics.test_strain_cells_in_motion import SIZE, unstructured
from tests.scenes import bar, scene, simulation

FACTORS = {"preconditioner": "cholesky", "update": "every-1", "factor_precision": "float64"}
NEARLY = 0.499  # Poisson's ratio


def table(name: str, young: float, poisson: float) -> dict[str, float]:
    """Constants of a law with these moduli at small strains."""
    if name != "mooney_rivlin":
        return {"young": young, "poisson": poisson}
    shear = young / (2 * (1 + poisson))
    return {"c1": shear / 4, "c2": shear / 4, "bulk": young / (3 * (1 - 2 * poisson))}


def tip(mesh: Mesh, name: str, kind: str, poisson: float) -> float:
    """Mean deflection of the free end under a small weight, held at Z = 0 [m]."""
    o = bar(young=None, fixed="Z < 1e-6", elements=kind)
    o["effects"][name] = table(name, 1e6, poisson)
    integrator = {"scheme": "quasi_static", "linearizations": 12, "tolerance": 1e-6}
    made = scene(o, gravity=(0, -1e-3, 0), integrator=integrator, tolerance=1e-8, **FACTORS)
    made.objects[0].use_mesh(mesh)
    sim = Simulation(made)
    assert Driver(sim).advance(1)["status"][0] == SolveStatus.CONVERGED
    end = sim.world.rest[:, 2] > SIZE[2] - 1e-9
    return float((sim.world.rest - sim.world.x)[end, 1].mean())


def test_they_do_not_lock():
    """Like corotational patches, a little stiffer, and all laws alike at small strains."""
    mesh = unstructured()
    names = ("neo_hookean", "stable_neo_hookean", "mooney_rivlin")
    found = {name: [tip(mesh, name, "patch", nu) for nu in (0.3, NEARLY)] for name in names}
    linear = [tip(mesh, "neo_hookean", "linear", nu) for nu in (0.3, NEARLY)]
    patches = [tip(mesh, "corotational", "patch", nu) for nu in (0.3, NEARLY)]
    for usual, nearly in found.values():
        assert 0.92 * patches[0] < usual < patches[0]
        assert 0.92 * patches[1] < nearly < patches[1]
        assert usual == pytest.approx(found["neo_hookean"][0], rel=1e-3)
        assert nearly == pytest.approx(found["neo_hookean"][1], rel=1e-3)
    assert found["neo_hookean"][1] > 5 * linear[1]


def test_bars_of_mirrored_cells_bend_more_than_with_linear_elements():
    """These bars lock least."""
    cells = {"bar": [2, 2, 8], "size": [1, 1, 4], "split": "mirrored"}
    found = {}
    for kind in ("linear", "patch"):
        o = bar(young=None, fixed="Z < 1e-6", elements=kind, mesh=cells)
        o["effects"]["neo_hookean"] = table("neo_hookean", 1e6, NEARLY)
        integrator = {"scheme": "quasi_static", "linearizations": 12, "tolerance": 1e-6}
        sim = simulation(o, gravity=(0, -1e-3, 0), integrator=integrator, tolerance=1e-8, **FACTORS)
        Driver(sim).advance(1)
        found[kind] = float((sim.world.rest - sim.world.x)[sim.world.rest[:, 2] > 3.999, 1].mean())
    assert found["patch"] > found["linear"]


@every_law
@pytest.mark.parametrize("scheme", ["backward_euler", "newmark", "bdf2", "generalized_alpha", "ros2"])
def test_a_soft_beam_falls_far_and_every_step_converges(law, scheme):
    """By a quarter of its length or more, no element turned over."""
    sim = law_bar(law, cells=(8, 2, 2), size=(4, 1, 1), fixed="X < 0.01", elements="patch", gravity=(0, -9.81, 0),
                  integrator={"scheme": scheme}, **FACTORS)  # fmt: skip
    records = Driver(sim).advance(30)
    assert (records["status"] == SolveStatus.CONVERGED).all()
    assert (sim.world.rest - sim.world.x)[:, 1].max() > 1 and determinants(sim).min() > 0


@pytest.mark.parametrize("name", ["neo_hookean", "stable_neo_hookean"])
def test_newtons_iteration_converges_quadratically(name):
    """The exponent log(r3 / r2) / log(r2 / r1) of consecutive residuals."""
    left = []
    for most in (3, 4, 5):
        sim = law_bar(
            name, cells=(6, 2, 2), size=(3, 1, 1), fixed="X < 0.01", gravity=(0, -9.81, 0), dt=1.0, projection="none",
            integrator={"linearizations": most, "tolerance": 1e-15, "trials": 0, "scheme": "quasi_static"},
            tolerance=1e-12, preconditioner="block_jacobi", max_iterations=3000, elements="patch",
            table={"young": 2e6, "poisson": 0.45},
        )  # fmt: skip
        sim.engine.run(1)
        left.append(sim.engine.records()["nonlinear"][0])
    exponent = np.log(left[2] / left[1]) / np.log(left[1] / left[0])
    assert 1e-13 < left[2] < 1e-6 and exponent > 1.8, (left, exponent)


@pytest.mark.parametrize("name", ["stable_neo_hookean", "neo_hookean, regularized", "mooney_rivlin, regularized"])
def test_a_body_turned_over_at_random_comes_back(name):
    """Some elements and the mean of some patches begin below J = 0."""
    sim = law_bar(LAWS[name], cells=(4, 2, 2), elements="patch", damping=(2.0, 0.0), preconditioner="block_jacobi",
                  tolerance=1e-6, max_iterations=2000)  # fmt: skip
    sim.world.x[:] = np.random.default_rng(3).permutation(sim.world.x)
    effect = elements(sim)
    mean = np.bincount(effect.patch, effect.volume * determinants(sim)) / effect.patch_volume
    assert (determinants(sim) < 0).sum() > 10 and (mean < 0).any()
    for _ in range(6):
        Driver(sim).advance(50)
        assert np.isfinite(sim.world.x).all() and np.isfinite(sim.potential_energy())
    assert determinants(sim).min() > 0 and sim.world.x.std() < 2 * sim.world.rest.std()


@pytest.mark.parametrize("name", ["neo_hookean", "arruda_boyce"])
def test_an_element_that_the_law_does_not_define_is_named(name):
    sim = law_bar(LAWS[name], cells=(2, 1, 1), elements="patch")
    sim.world.x[int(np.argmin(np.abs(sim.world.rest - [0, 1, 1]).sum(axis=1)))] += [1.2, -0.3, -0.2]
    bad = np.flatnonzero(determinants(sim) <= 0)
    records = Driver(sim).advance(2)
    assert len(bad) and (records["status"] == SolveStatus.NOT_FINITE).all()
    assert [r.element for r in sim.refusals()] == sorted(elements(sim).number[bad])
    assert np.isfinite(sim.world.x).all()


@pytest.mark.parametrize("damping", [(0.1, 0.0), (0.1, 0.01)])
def test_stages_without_a_matrix_have_the_forces_of_the_others(damping):
    """ros2 by the factor alone and by iterations are the same scheme."""
    ends = []
    for solve in ("iterate", "auto"):
        sim = law_bar("neo_hookean", cells=(4, 1, 1), fixed="X < 0.01", damping=damping, elements="patch",
                      gravity=(0, -9.81, 0), dt=0.005, integrator={"scheme": "ros2", "solve": solve}, tolerance=1e-9,
                      **FACTORS)  # fmt: skip
        assert (Driver(sim).advance(40)["status"] == SolveStatus.CONVERGED).all()
        ends.append(sim.world.x.copy())
    assert np.abs(ends[0] - sim.world.rest).max() > 0.05
    assert np.abs(ends[0] - ends[1]).max() < 0.01 * np.abs(ends[0] - sim.world.rest).max()


@pytest.mark.parametrize("name", ["neo_hookean", "mooney_rivlin"])
def test_the_energy_of_each_step_balances(name):
    """With Newmark's scheme solved exactly, small motions keep it."""
    sim = law_bar(LAWS[name], cells=(3, 1, 1), fixed="X < 0.01", elements="patch", gravity=(0, -1e-4, 0), dt=0.01,
                  integrator={"scheme": "newmark", "linearizations": 10, "tolerance": 1e-10},
                  preconditioner="block_jacobi", tolerance=1e-12, max_iterations=3000)  # fmt: skip
    sim.engine.loop.energy_every = 1
    sim.engine.run(60)
    records = sim.engine.records()
    swing = records["kinetic"].max()
    lost = records["budget"] - records["kinetic"] - records["elastic"]
    assert swing > 0 and np.abs(lost).max() < 2e-3 * swing
    assert records["elastic"][-1] == pytest.approx(elements(sim).energy(), rel=1e-9)


@every_law
@pytest.mark.parametrize("scheme", ["backward_euler", "ros2"])
def test_workers_assemble_the_same_matrix(law, scheme):
    sim = law_bar(law, cells=(4, 2, 2), fixed="X < 0.01", elements="patch", gravity=(0, -9.81, 0),
                  integrator={"scheme": scheme})  # fmt: skip
    built = Assembly(messages.scene(sim), messages.topology(sim, sim.world.bodies[0]))
    sim.world.x += 0.02 * np.random.default_rng(1).normal(size=sim.world.x.shape)
    sim.engine.assemble()
    assert built.matrix(sim.world.x.copy()).tobytes() == sim.system.values.tobytes()


def several(*kinds: tuple[str, str], first: int = 0) -> Simulation:
    objects = []
    for k, (name, kind) in enumerate(kinds, first):
        pose = {"translate": [0, 3.0 * k, 0]}
        o = bar((3, 2, 2), name=f"b{k}", young=None, fixed="X < 0.01", elements=kind, pose=pose)
        o["effects"][name] = table(name, 1e5, 0.4)
        objects.append(o)
    return simulation(*objects, gravity=(0, -9.81, 0), preconditioner="block_jacobi", tolerance=1e-9)


def test_bodies_of_all_kinds_in_one_scene_move_as_alone():
    kinds = [("neo_hookean", "patch"), ("neo_hookean", "linear"), ("corotational", "patch"),
             ("mooney_rivlin", "patch"), ("neo_hookean", "patch")]  # fmt: skip
    together = several(*kinds)
    together.engine.run(15)
    for k, kind in enumerate(kinds):
        alone = several(kind, first=k)
        alone.engine.run(15)
        assert np.abs(together.world.x[together.world.bodies[k].nodes] - alone.world.x).max() < 1e-7
    assert np.abs(together.world.x - together.world.rest).max() > 0.05


def test_fibres_beside_stay_those_of_the_tetrahedra():
    ends = []
    for stiffness in (None, 1e5):
        o = bar((4, 2, 2), young=None, fixed="X < 0.01", elements="patch")
        o["effects"]["neo_hookean"] = table("neo_hookean", 1e5, NEARLY)
        if stiffness:
            o["effects"]["fibres"] = {"stiffness": stiffness, "direction": [1, 0, 0]}
        sim = simulation(o, gravity=(0, -9.81, 0), preconditioner="block_jacobi")
        assert (Driver(sim).advance(20)["status"] == SolveStatus.CONVERGED).all()
        ends.append(-sim.world.x[:, 1].min())
    assert 0 < ends[1] < ends[0]


def test_parameters_that_are_set_are_as_if_they_had_been_in_the_scene():
    def made(young: float, poisson: float) -> Simulation:
        given = {"young": young, "poisson": poisson}
        return law_bar("neo_hookean", table=given, fixed="X < 0.01", elements="patch", gravity=(0, -9.81, 0))

    sim, other = made(1e5, 0.3), made(3e5, 0.4)
    sim.parameters.set({"bar.neo_hookean.young": "3e5", "bar.neo_hookean.poisson": "0.4"})
    for s in (sim, other):
        s.engine.run(10)
    assert sim.world.x.tobytes() == other.world.x.tobytes()


def test_one_body_is_reset_and_goes_on_as_at_the_start():
    sim = several(("neo_hookean", "patch"), ("neo_hookean", "patch"))
    start, driver, first = Start(sim), Driver(sim), sim.world.bodies[0]
    driver.advance(6)
    after = sim.world.x[first.nodes].copy()
    driver.advance(3)
    start.reset("b0")
    driver.advance(6)
    assert np.abs(sim.world.x[first.nodes] - after).max() < 1e-9


def test_threads_change_nothing():
    ends = []
    for threads in (1, 2):
        sim = law_bar("neo_hookean", cells=(12, 5, 5), fixed="X < 0.01", elements="patch", gravity=(0, -9.81, 0),
                      threads=threads, preconditioner="block_jacobi")  # fmt: skip
        sim.engine.run(3)
        ends.append(sim.world.x.tobytes())
    assert ends[0] == ends[1]
