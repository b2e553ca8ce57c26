# SPDX-License-Identifier: MIT
"""Springs: energy, forces and tangent against finite differences and the plain reference; what a step keeps."""

from pathlib import Path

import numpy as np
import pytest

from sim_server.effects.mass_spring import CALIBRATION, MassSpring
from sim_server.errors import InputError
from sim_server.simulation import Simulation
from tests.physics.test_forces import elastic_forces, stir, stirred
from tests.physics.test_system_matrix import frame
from tests.reference.mass_spring import Net
from tests.scenes import bar, jittered_bar, mesh_file, random_rotations, simulation
from tests.texts import module_in

SIZE = (1.5, 1.0, 0.8)
REGIONS = [{"where": "X < 0.6", "young": 4e5}, {"young": 3e4}]


def springs_bar(springs: dict, damping: float = 0.0, fixed: str | None = None, **table) -> dict:
    """An [[object]]: a bar with this table of mass_spring."""
    made = bar(young=None, fixed=fixed, damping=(0.0, damping) if damping else None, **table)
    made["effects"]["mass_spring"] = springs
    return made


def unequal(folder: Path, dt: float = 0.02, warp: bool = False, **table) -> Simulation:
    """A bar of unequal elements and two materials."""
    mesh = mesh_file(folder, *jittered_bar((3, 2, 2), SIZE, seed=2))
    return simulation(springs_bar({"young": REGIONS}, mesh=mesh, **table), dt=dt, warp=warp)


def springs(sim: Simulation) -> MassSpring:
    effect = sim.effects["mass_spring"]
    assert isinstance(effect, MassSpring)
    return effect


def net(sim: Simulation) -> Net:
    e, w = springs(sim), sim.world
    return Net(e.elements, e.stiffness, e.length, w.x.copy(), w.v.copy(), w.mass, w.free, w.dt, float(w.beta[0]))


@stirred
def test_energy_is_that_of_the_reference(tmp_path, size):
    sim = unequal(tmp_path)
    stir(sim, size)
    assert sim.potential_energy() == pytest.approx(net(sim).energy(), rel=1e-12)


@stirred
def test_forces_are_minus_the_slope_of_the_energy(tmp_path, size):
    """Central differences, node by node."""
    sim = unequal(tmp_path)
    stir(sim, size, seed=5)
    x, step = sim.world.x, 1e-6
    slope = np.zeros_like(x)
    for index in np.ndindex(*x.shape):
        at, energy = x[index], []
        for x[index] in (at + step, at - step):
            energy.append(sim.potential_energy())
        x[index] = at
        slope[index] = (energy[0] - energy[1]) / (2 * step)
    forces = elastic_forces(sim)
    assert np.abs(forces + slope).max() < 1e-7 * np.abs(forces).max()
    assert np.abs(forces - net(sim).forces()).max() < 1e-12 * np.abs(forces).max()


@stirred
@pytest.mark.parametrize("fixed", [None, "X < 0.01"])
@pytest.mark.parametrize("beta", [0.0, 0.03])
def test_matrix_and_right_side_are_those_of_the_reference(tmp_path, size, fixed, beta):
    sim = unequal(tmp_path, fixed=fixed, damping=beta, dt=0.013)
    stir(sim, size)
    sim.engine.assemble()
    found, expected = sim.matrix().toarray(), net(sim).matrix()
    assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()
    assert np.array_equal(found, found.T) and np.linalg.eigvalsh(found)[0] > 0
    b = net(sim).right_side()
    assert np.abs(sim.system.b - b).max() < 1e-12 * np.abs(b).max()


def test_in_the_material_frame(tmp_path):
    """Springs have no rotations; the nodes' are those of matched shapes."""
    sim = unequal(tmp_path, warp=True)
    stir(sim, 0.05)
    sim.engine.assemble()
    A, R = net(sim).matrix(), frame(sim)
    assert np.abs(R - np.eye(len(R))).max() > 0.01
    assert np.abs(sim.matrix().toarray() - R.T @ A @ R).max() < 1e-12 * np.abs(A).max()


def test_the_tangent_under_tension_is_the_slope_of_the_forces(tmp_path):
    sim = unequal(tmp_path)
    sim.world.x[:] = 1.4 * sim.world.rest
    stir(sim, 0.01)
    e, w = springs(sim), sim.world
    assert (np.linalg.norm(w.x[e.elements[:, 1]] - w.x[e.elements[:, 0]], axis=1) > e.length).all()
    sim.engine.assemble()
    K = (sim.matrix().toarray() - np.diag(np.repeat(w.mass, 3))) / w.dt**2
    step, columns = 1e-6, []
    for index in np.ndindex(*w.x.shape):
        at, forces = w.x[index], []
        for w.x[index] in (at + step, at - step):
            forces.append(elastic_forces(sim).ravel().copy())
        w.x[index] = at
        columns.append((forces[1] - forces[0]) / (2 * step))
    assert np.linalg.norm(K - np.array(columns).T) < 1e-7 * np.linalg.norm(K)


@pytest.mark.parametrize("scale", [0.9, 0.5, 0.1])
def test_a_compressed_lattice_has_a_definite_matrix(tmp_path, scale):
    """All springs are pushed together. The tangent itself is indefinite, and so would be A with it at this step; the
    step with what is left of it gives energy back."""
    sim = unequal(tmp_path, dt=0.1)
    sim.world.x[:] = scale * sim.world.rest
    sim.engine.assemble()
    A, as_it_is = sim.matrix().toarray(), net(sim).matrix(clamped=False)
    assert np.linalg.eigvalsh(as_it_is)[0] < -1
    assert np.linalg.eigvalsh(A)[0] >= 0.999 * sim.world.mass.min()
    energy = [sim.potential_energy()]
    for _ in range(60):
        sim.engine.run(1)
        energy.append(sim.potential_energy() + sim.kinetic_energy())
    assert (sim.engine.records()["status"] == 0).all()
    assert np.diff(energy).max() < 1e-9 * energy[0] and energy[-1] < 0.05 * energy[0]


def test_nodes_all_in_one_place_come_apart(tmp_path):
    """Exactly in one place no spring has a direction and nothing moves; 1e-6 m beside it, the net unfolds."""
    sim = unequal(tmp_path)
    sim.world.x[:] = 0
    sim.engine.run(1)
    assert not sim.world.x.any() and (sim.engine.records()["status"] == 0).all()
    sim.world.x += 1e-6 * np.random.default_rng(1).normal(size=sim.world.x.shape)
    start = sim.potential_energy()
    sim.engine.run(200)
    assert np.isfinite(sim.world.x).all() and np.ptp(sim.world.x, axis=0).min() > 0.3
    assert sim.potential_energy() + sim.kinetic_energy() < start


def test_rigid_motion_is_free_of_force_and_forces_balance(tmp_path):
    sim = unequal(tmp_path)
    for R in random_rotations(5, seed=7):
        sim.world.x[:] = sim.world.rest @ R.T + [3.0, -2.0, 7.0]
        assert np.abs(elastic_forces(sim)).max() < 1e-13 * 4e5
    stir(sim, 0.1)
    forces = elastic_forces(sim)
    size = np.abs(forces).max() * len(forces)
    assert np.abs(forces.sum(axis=0)).max() < 1e-13 * size
    assert np.abs(np.cross(sim.world.x, forces).sum(axis=0)).max() < 1e-12 * size


def test_momentum_of_a_free_net(tmp_path):
    """The residual of each solve is all that may be lost of it."""
    mesh = mesh_file(tmp_path, *jittered_bar((3, 2, 2), SIZE, seed=2))
    table = springs_bar({"young": 2e5}, mesh=mesh)
    sim = simulation(table, tolerance=1e-12, max_iterations=2000, preconditioner="block_jacobi")
    stir(sim, 0.02)
    mass = sim.world.mass
    before = mass @ sim.world.v
    sim.engine.run(100)
    assert (sim.engine.records()["status"] == 0).all()
    assert np.linalg.norm(mass @ sim.world.v - before) < 1e-9 * np.linalg.norm(before)


def test_stiffness_follows_young_and_volume(tmp_path):
    """k l0^2 = 1.12 sum E V over the elements at the edge, region by region."""
    sim = unequal(tmp_path)
    body, e = sim.world.bodies[0], springs(sim)
    X = body.mesh.rest[body.mesh.tets]
    volume = np.linalg.det(X[:, 1:] - X[:, :1]) / 6
    young = np.where(body.centroids[:, 0] < 0.6, 4e5, 3e4)
    assert np.array_equal(e.elastic[0][0], young) and (e.elastic[0][1] == 0.25).all()
    for ends, k, l0 in list(zip(e.elements, e.stiffness, e.length, strict=True))[::7]:
        at = np.isin(body.mesh.tets, ends).sum(axis=1) == 2
        assert k * l0**2 == pytest.approx(CALIBRATION * (young * volume)[at].sum(), rel=1e-12)
        assert l0 == pytest.approx(np.linalg.norm(body.mesh.rest[ends[1]] - body.mesh.rest[ends[0]]), rel=1e-14)


def test_listed_springs_hold_what_hangs_on_them():
    """One mesh of one cell held at X = 0, its other nodes on springs of rest length 0.5 from the held ones: gravity
    stretches each by m g / k beyond it, in the direction of gravity."""
    pairs = [[i, i + 1] for i in (0, 2, 4, 6)]  # along x
    springs = {"springs": pairs, "stiffness": [200.0, 100.0, 50.0, 100.0], "rest_length": 0.5}
    cell: dict = {"mesh": {"bar": [1, 1, 1], "size": [1, 1, 1], "split": "kuhn"}, "mass": 8.0, "masses": "equal"}
    table = springs_bar(springs, fixed="X < 0.01", damping=0.2, **cell)
    sim = simulation(table, gravity=(10.0, 0.0, 0.0), dt=0.1, tolerance=1e-12)
    held = np.flatnonzero(sim.world.free == 0)
    assert held.tolist() == [0, 2, 4, 6]
    sim.engine.run(400)
    np.testing.assert_allclose(sim.world.x[[1, 3, 5, 7], 0], 0.5 + 10.0 / np.array([200, 100, 50, 100]), rtol=1e-6)


def test_a_file_of_pairs(tmp_path):
    path = tmp_path / "pairs.txt"
    path.write_text("# along x\n0 1\n\n2 3  # and here\n")
    sim = simulation(springs_bar({"springs": str(path), "stiffness": 3.0}))
    assert springs(sim).elements.tolist() == [[0, 1], [2, 3]]
    assert (springs(sim).stiffness == 3.0).all() and springs(sim).elastic == {}
    np.testing.assert_allclose(springs(sim).length, 0.5)
    text = '[[object]]\nname = "bar"\nmesh = { bar = [4, 2, 2], size = [2, 1, 1], split = "kuhn" }\n[object.effects]\n'
    (tmp_path / "scene.toml").write_text(f'dt = 0.02\n{text}mass_spring = {{ springs = "pairs.txt", stiffness = 3 }}\n')
    assert springs(Simulation.load(tmp_path / "scene.toml")).elements.tolist() == [[0, 1], [2, 3]]
    path.write_text("0 1\n2 -3\n")
    with pytest.raises(InputError, match=r"'bar', effect mass_spring: .*pairs.txt, line 2: '2 -3' is not two node"):
        simulation(springs_bar({"springs": str(path), "stiffness": 3.0}))


WRONG = {
    "no spring": ({"springs": [], "stiffness": 1.0}, "springs has no pair of nodes"),
    "no such node": ({"springs": [[0, 1], [3, 45]], "stiffness": 1.0}, r"spring 2 joins \[3, 45\]: .* from 0 to 44"),
    "one node": ({"springs": [[7, 7]], "stiffness": 1.0}, r"spring 1 joins \[7, 7\]: must be two different nodes"),
    "twice": ({"springs": [[0, 1], [1, 0]], "stiffness": 1.0}, r"springs lists \[0, 1\] more than once"),
    "too few": ({"springs": [[0, 1], [1, 2]], "stiffness": [1.0]}, "stiffness has 1 values for 2 springs"),
    "no region": ({"young": [{"where": "X < 1", "young": 1e4}]}, "element .* is in no region of young"),
}


@pytest.mark.parametrize(("table", "message"), WRONG.values(), ids=WRONG.keys())
def test_springs_that_cannot_be_built(table, message):
    with pytest.raises(InputError, match=f"object 'bar', effect mass_spring: {message}"):
        simulation(springs_bar(table))


def test_beside_other_elements_they_add_up(tmp_path):
    """Corotational tetrahedra with springs across them, one body; and springs alone on another."""
    pairs = {"springs": [[0, 4], [1, 30], [2, 3], [44, 40]], "stiffness": 4e4}
    both, tied, solid = bar(young=2e5), springs_bar(pairs), bar(young=2e5)
    both["effects"]["mass_spring"] = pairs
    alone = springs_bar({"young": 1e5}, name="net")
    matrices = []
    for objects in ([both, alone], [tied], [solid]):
        sim = simulation(*objects, warp=False)
        stir(sim, 0.0)
        sim.world.x += 0.05 * np.sin(9 * sim.world.rest[:, [1, 2, 0]])
        sim.engine.assemble()
        matrices.append((sim.matrix().toarray(), sim.potential_energy(), sim.world.mass))
    (whole, _, mass), (net_of_it, _, _), (solid_of_it, _, _) = matrices
    expected = net_of_it + solid_of_it - np.diag(np.repeat(mass[:45], 3))
    assert np.abs(whole - expected).max() < 1e-13 * np.abs(expected).max()
    sim = simulation(both, alone, preconditioner="block_jacobi")
    sim.engine.run(5)
    assert (sim.engine.records()["status"] == 0).all()


@pytest.mark.parametrize("size", [0.02, 0.1])
def test_single_precision_agrees(tmp_path, size):
    sim = unequal(tmp_path)
    stir(sim, size)
    e, w, results = springs(sim), sim.world, []
    for real, dtype in (("float", np.float32), ("double", np.float64)):
        m = len(e.elements)
        x, v, k, l0 = (a.astype(dtype) for a in (w.x, w.v, e.stiffness, e.length))
        tangent, impulse, energy = np.zeros((m, 4), dtype), np.zeros((m, 3), dtype), np.zeros(m, dtype)
        text = module_in("effects/mass_spring.cu", real)
        c = np.full(m, w.dt**2, dtype)
        text.bind(
            "springs", m, ends=e.elements, x=x, v=v, stiffness=k, length=l0, stiffness_coefficient=c, h=w.dt,
            tangent=tangent, nodal_impulse=impulse,
        )()  # fmt: skip
        text.bind("energy", m, ends=e.elements, x=x, stiffness=k, length=l0, energy=energy)()
        d = tangent[:, 3]
        K = np.einsum("ei,ej->eij", tangent[:, :3], tangent[:, :3]) + d[:, None, None] * np.eye(3, dtype=dtype)
        results.append([K, impulse, energy])
    for single, double in zip(*results, strict=True):
        assert np.abs(single - double).max() < 1e-5 * np.abs(double).max()


def test_what_a_log_holds_is_a_scene_again(tmp_path):
    from sim_server.scene.model import Scene

    for table in ({"young": REGIONS}, {"springs": [[0, 1]], "stiffness": 2.0}):
        resolved = simulation(springs_bar(table)).scene.resolved()
        assert Scene.model_validate(resolved).resolved() == resolved
