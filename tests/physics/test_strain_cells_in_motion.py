# SPDX-License-Identifier: MIT
"""Bodies of strain cells in scenes: locking, factors, other schemes, energies, workers, several bodies, parameters."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from sim_server.mesh import Mesh, pose_matrix
from sim_server.recording import messages
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.state.start import Start
from sim_server.updates.driver import Driver
from sim_server.updates.worker_assembly import Assembly
from tests.scenes import bar, scene, simulation

KINDS = ("patch", "smoothed", "quadratic")
every_kind = pytest.mark.parametrize("kind", KINDS)
SIZE = (1.0, 1.0, 4.0)


def unstructured(cells: tuple[int, int, int] = (2, 2, 8), seed: int = 0) -> Mesh:
    """A box of tetrahedra without preferred directions."""
    grid = np.stack(np.meshgrid(*(np.arange(k + 1.0) for k in cells), indexing="ij"), axis=-1).reshape(-1, 3)
    moved = np.random.default_rng(seed).uniform(-0.3, 0.3, grid.shape) * ((grid > 0) & (grid < cells))
    rest = (grid + moved) * np.array(SIZE) / cells
    tets = Delaunay(rest).simplices
    volume = np.linalg.det(rest[tets[:, 1:]] - rest[tets[:, :1]]) / 6
    tets[volume < 0] = tets[volume < 0][:, [0, 1, 3, 2]]
    tets = tets[np.abs(volume) > 1e-6]
    assert len(np.unique(tets)) == len(rest)
    return Mesh(rest, tets.astype(np.int32))


def of_mesh(mesh: Mesh, kind: str, gravity: float, poisson: float, **table) -> Simulation:
    """Held at Z = 0, under its weight."""
    made = scene(
        bar(poisson=poisson, young=1e6, fixed="Z < 1e-6", elements=kind), gravity=(0, gravity, 0), **table
    )  # fmt: skip
    made.objects[0].use_mesh(mesh.with_mid_nodes() if kind == "quadratic" else mesh)
    return Simulation(made)


def tip(mesh: Mesh, kind: str, poisson: float) -> float:
    """Mean deflection of the free end under a small weight [m]."""
    integrator = {"scheme": "quasi_static", "linearizations": 12, "tolerance": 1e-6}
    solver = {"preconditioner": "cholesky", "update": "every-1", "factor_precision": "float64", "tolerance": 1e-8}
    sim = of_mesh(mesh, kind, -1e-3, poisson, integrator=integrator, **solver)
    assert Driver(sim).advance(1)["status"][0] == 0
    end = sim.world.rest[:, 2] > SIZE[2] - 1e-9
    return float((sim.world.rest - sim.world.x)[end, 1].mean())


def test_patches_do_not_lock():
    """Against quadratic elements of the same mesh, which converge from above."""
    mesh = unstructured()
    parts = {kind: [tip(mesh, kind, nu) / tip(mesh, "quadratic", nu) for nu in (0.3, 0.499)] for kind in
             ("linear", "patch", "smoothed")}  # fmt: skip
    assert parts["linear"][1] < 0.4 * parts["linear"][0]
    for kind in ("patch", "smoothed"):
        assert parts[kind][1] > 0.9 * parts[kind][0]
    assert parts["smoothed"][1] > 0.8 > parts["patch"][1] > 2 * parts["linear"][1]


def iterations(mesh: Mesh, kind: str, poisson: float, update: str, **table) -> NDArray:
    sim = of_mesh(mesh, kind, -9.81, poisson, preconditioner="cholesky", update=update, **table)
    records = Driver(sim).advance(40)
    assert (records["status"] == 0).all()
    return np.asarray(records["iterations"])


@every_kind
@pytest.mark.parametrize("update", ["lockstep-3", "lockstep-10"])
def test_an_old_factor_serves_them_nearly_as_well(kind, update):
    mesh = unstructured()
    linear, found = (iterations(mesh, k, 0.45, update).mean() for k in ("linear", kind))
    assert found < 2 * linear + 1  # though they move farther


@every_kind
def test_a_posed_body_moves_as_the_unposed_one(kind):
    runs = []
    for posed in (False, True):
        pose = {"pose": {"rotate": [40.0, 0.0, 70.0]}} if posed else {}
        R = pose_matrix((40.0, 0.0, 70.0)) if posed else np.eye(3)
        down = tuple(R @ [0, -9.81, 0])
        sim = simulation(
            bar((6, 2, 2), poisson=0.45, fixed="X < 0.01", elements=kind, **pose), gravity=down,
            preconditioner="cholesky", update="lockstep-3", tolerance=1e-9,
        )  # fmt: skip
        records = Driver(sim).advance(20)
        runs.append((sim.world.x @ R, records["iterations"].astype(int)))
    assert np.abs(runs[0][0] - runs[1][0]).max() < 1e-6
    assert np.abs(runs[0][1] - runs[1][1]).max() <= 1


@every_kind
@pytest.mark.parametrize("damping", [(0.1, 0.0), (0.1, 0.01)])
def test_stages_without_a_matrix_have_the_forces_of_the_others(kind, damping):
    """ros2 by the factor alone and by iterations are the same scheme; both take the energy out."""
    ends = []
    for solve in ("iterate", "auto"):
        sim = simulation(
            bar((4, 1, 1), poisson=0.45, young=1e6, fixed="X < 0.01", damping=damping, elements=kind),
            gravity=(0, -9.81, 0), dt=0.005, integrator={"scheme": "ros2", "solve": solve}, update="every-1",
            preconditioner="cholesky", tolerance=1e-9,
        )  # fmt: skip
        records = Driver(sim).advance(40)
        assert (records["status"] == 0).all()
        ends.append(sim.world.x.copy())
    assert np.abs(ends[0] - sim.world.rest).max() > 0.05
    assert np.abs(ends[0] - ends[1]).max() < 0.01 * np.abs(ends[0] - sim.world.rest).max()


@every_kind
def test_the_energy_of_each_step_is_told_and_balances(kind):
    """With Newmark's scheme solved exactly, small motions keep it; work and losses are none."""
    integrator = {"scheme": "newmark", "linearizations": 10, "tolerance": 1e-10}
    objects = [bar((3, 1, 1), young=1e6, fixed="X < 0.01", elements=kind, name=name) for name in ("a", "b")]
    sim = simulation(
        *objects, gravity=(0, -1e-3, 0), dt=0.01, integrator=integrator, preconditioner="block_jacobi",
        tolerance=1e-12, max_iterations=3000,
    )  # fmt: skip
    sim.engine.loop.energy_every = 1
    sim.engine.run(60)
    records = sim.engine.records()[::2]
    swing = records["kinetic"].max()
    lost = records["budget"] - records["kinetic"] - records["elastic"]
    assert swing > 0 and np.abs(lost).max() < 2e-3 * swing
    elastic = sum(e.energy() for e in sim.effects.values() if e.name == "corotational")
    assert sim.engine.records is not None and 2 * records["elastic"][-1] == pytest.approx(elastic, rel=1e-9)


@every_kind
@pytest.mark.parametrize("scheme", ["backward_euler", "ros2"])
def test_workers_assemble_the_same_matrix(kind, scheme):
    regions = [{"where": "X < 1", "young": 1e6}, {"young": 1e4}]
    given = bar((4, 2, 2), young=regions, fixed="X < 0.01", elements=kind)
    sim = simulation(given, gravity=(0, -9.81, 0), integrator={"scheme": scheme})
    built = Assembly(messages.scene(sim), messages.topology(sim, sim.world.bodies[0]))
    sim.world.x += 0.05 * np.random.default_rng(1).normal(size=sim.world.x.shape)
    sim.engine.assemble()
    assert built.matrix(sim.world.x.copy()).tobytes() == sim.system.values.tobytes()


def mixed(scheme: str, *kinds: str) -> Simulation:
    objects = [
        bar((3, 2, 2), name=f"b{k}", poisson=0.4, fixed="X < 0.01", elements=kind, pose={"translate": [0, 3.0 * k, 0]})
        for k, kind in enumerate(kinds)
    ]
    return simulation(
        *objects, gravity=(0, -9.81, 0), integrator={"scheme": scheme}, preconditioner="block_jacobi", tolerance=1e-9
    )


@pytest.mark.parametrize("scheme", ["backward_euler", "ros2"])
def test_bodies_of_all_kinds_in_one_scene_move_as_alone(scheme):
    kinds = ("smoothed", "linear", "patch", "quadratic", "smoothed")
    together = mixed(scheme, *kinds)
    together.engine.run(15)
    for k, kind in enumerate(kinds):
        alone = mixed(scheme, kind)
        alone.engine.run(15)
        found = together.world.x[together.world.bodies[k].nodes] - [0, 3.0 * k, 0]
        assert np.abs(found - alone.world.x).max() < 1e-7
    assert np.abs(together.world.x - together.world.rest).max() > 0.05


@every_kind
def test_parameters_that_are_set_are_as_if_they_had_been_in_the_scene(kind):
    def made(young: float, poisson: float) -> Simulation:
        return simulation(bar(young=young, poisson=poisson, fixed="X < 0.01", elements=kind), gravity=(0, -9.81, 0))

    sim, other = made(1e5, 0.3), made(3e5, 0.4)
    sim.parameters.set({"bar.corotational.young": "3e5", "bar.corotational.poisson": "0.4"})
    for s in (sim, other):
        s.engine.run(10)
    assert sim.world.x.tobytes() == other.world.x.tobytes()


@every_kind
def test_one_body_is_reset_and_goes_on_as_at_the_start(kind):
    sim = mixed("ros2", kind, kind)
    start = Start(sim)
    driver = Driver(sim)
    driver.advance(6)
    first = sim.world.bodies[0]
    after = sim.world.x[first.nodes].copy()
    driver.advance(3)
    start.reset("b0")
    driver.advance(6)
    assert np.abs(sim.world.x[first.nodes] - after).max() < 1e-9


@every_kind
def test_threads_change_nothing(kind):
    ends = []
    for threads in (1, 2):
        sim = simulation(
            bar((12, 5, 5), fixed="X < 0.01", elements=kind), gravity=(0, -9.81, 0), threads=threads,
            preconditioner="block_jacobi",
        )  # fmt: skip
        sim.engine.run(3)
        ends.append(sim.world.x.tobytes())
    assert ends[0] == ends[1]


def test_quasi_static_scenes_with_springs_and_fibres_beside_take_them():
    """Springs and fibres stay those of the tetrahedra, and their blocks are added to the same system."""
    table = bar((4, 2, 2), poisson=0.45, fixed="X < 0.01", elements="smoothed")
    table["effects"] |= {"mass_spring": {"young": 1e4}, "fibres": {"stiffness": 1e4, "direction": [1, 0, 0]}}
    sim = simulation(table, gravity=(0, -1, 0), integrator={"scheme": "quasi_static"}, preconditioner="block_jacobi")
    plain = simulation(
        bar((4, 2, 2), poisson=0.45, fixed="X < 0.01", elements="smoothed"), gravity=(0, -1, 0),
        integrator={"scheme": "quasi_static"}, preconditioner="block_jacobi",
    )  # fmt: skip
    for s in (sim, plain):
        s.engine.run(10)
    assert isinstance(sim.scene, Scene) and 0 < -sim.world.x[:, 1].min() < -plain.world.x[:, 1].min()
