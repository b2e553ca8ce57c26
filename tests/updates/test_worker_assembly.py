# SPDX-License-Identifier: MIT
"""A matrix built from a description and positions is the one that the server assembles; what cannot be, is refused."""

import json
from dataclasses import replace

import meshio
import numpy as np
import pytest

from protocol import messages_pb2 as pb
from protocol.refused import Refused
from sim_server.mesh import bar as bar_mesh
from sim_server.recording import messages
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Inline, Job
from sim_server.updates.worker_assembly import Assembly
from tests.scenes import bar, jittered_bar, mesh_file, scene, simulation

SPRINGS = {"mass_spring": {"young": 1e5}}
SOLIDS = {
    "corotational": bar((4, 2, 2), damping=(0.1, 0.02), fixed="X < 0.01"),
    "regions": bar((4, 2, 2), young=[{"where": "X < 1", "young": 1e6}, {"young": 1e4}], fixed="X < 0.01"),
    "posed": bar((4, 2, 2), pose={"rotate": [40, 0, 70], "translate": [1, 2, 3]}, fixed="X < 0.01"),
    "springs": {"name": "bar", "mesh": {"bar": [4, 2, 2], "size": [2, 1, 1], "split": "kuhn"}, "effects": SPRINGS},
    "a memory, which is not in the matrix": bar(
        (4, 2, 2),
        young=None,
        effects={
            "corotational": {"young": 1e5, "poisson": 0.3},
            "prony": {"terms": [{"g": 0.5, "tau": 0.1}]},
        },
    ),
    "equal masses": bar((4, 2, 2), mass=5.0, masses="equal"),
}


def described(sim: Simulation, body: int = 0) -> tuple[pb.Scene, pb.Topology]:
    """As a worker gets it."""
    topology = messages.topology(sim, sim.world.bodies[body])
    return pb.Scene.FromString(messages.scene(sim).SerializeToString()), topology


def deformed(sim: Simulation, seed: int = 0) -> None:
    rng = np.random.default_rng(seed)
    sim.world.x += 0.05 * rng.normal(size=sim.world.x.shape)
    sim.world.v += rng.normal(size=sim.world.v.shape)


@pytest.mark.parametrize("solid", SOLIDS.values(), ids=SOLIDS.keys())
@pytest.mark.parametrize("warp", [True, False])
def test_the_same_matrix_bit_for_bit(solid, warp):
    sim = simulation(solid, gravity=(0, -9.81, 0), warp=warp)
    built = Assembly(*described(sim))
    for seed in range(3):
        deformed(sim, seed)
        sim.engine.assemble()
        assert built.matrix(sim.world.x.copy()).tobytes() == sim.system.values.tobytes()


@pytest.mark.parametrize("scheme", ["newmark", "bdf2", "generalized_alpha", "quasi_static", "ros2"])
def test_the_same_matrix_under_any_integrator(scheme):
    sim = simulation(
        bar((4, 2, 2), fixed="X < 0.01", damping=(0.1, 0.02)), gravity=(0, -1, 0), integrator={"scheme": scheme}
    )
    Driver(sim).advance(5)
    sim.engine.assemble()
    assert sim.world.bodies[0].effects["corotational"].tangent == ("usual" if scheme == "quasi_static" else "exact")
    assert Assembly(*described(sim)).matrix(sim.world.x.copy()).tobytes() == sim.system.values.tobytes()


def test_the_same_matrix_beside_obstacles_which_the_worker_leaves_out(tmp_path):
    """Also where their files are not there: contact adds nothing to A."""
    path, cube = tmp_path / "cube.vtk", bar_mesh((2, 2, 2), (1, 1, 1))
    meshio.Mesh(cube.rest, [("tetra", cube.tets)]).write(path)
    obstacles = [{"name": "floor", "shape": "plane"}, {"name": "a", "shape": "grid", "file": str(path), "spacing": 0.2}]
    effects = {"contact": {"friction": [{"between": ["b", "floor"], "value": 0.1}]}}
    bars = [bar((4, 2, 2)), bar((1, 1, 1), name="b")]
    table = {"name": "test", "dt": 0.02, "effects": effects, "object": bars, "obstacle": obstacles}
    sim = Simulation(Scene.model_validate(table, context={"folder": "."}))
    path.unlink()
    deformed(sim)
    sim.engine.assemble()
    body = sim.world.bodies[0]
    values = Assembly(*described(sim)).matrix(sim.world.x[body.nodes].copy())
    np.testing.assert_allclose(values, sim.system.body_values(body.first, body.last), rtol=1e-12, atol=1e-12)


def test_each_of_several_bodies_by_itself():
    sim = simulation(bar((4, 2, 2), name="a", fixed="X < 0.01"), bar((3, 2, 1), name="b", young=3e5))
    deformed(sim)
    sim.engine.assemble()
    for body in sim.world.bodies:
        values = Assembly(*described(sim, body.index)).matrix(sim.world.x[body.nodes].copy())
        np.testing.assert_allclose(values, sim.system.body_values(body.first, body.last), rtol=1e-12, atol=1e-12)


def test_a_mesh_from_a_file_comes_with_the_topology(tmp_path):
    """The file itself is not there where the worker is."""
    mesh = mesh_file(tmp_path, *jittered_bar((4, 2, 2), (2.0, 1.0, 1.0)))
    sim = simulation(bar(mesh=mesh, pose={"rotate": [0, 30, 0]}, fixed="X < 0.01"))
    (tmp_path / "mesh.vtu").unlink()
    deformed(sim)
    sim.engine.assemble()
    assert Assembly(*described(sim)).matrix(sim.world.x.copy()).tobytes() == sim.system.values.tobytes()


def test_settings_of_the_servers_device_do_not_matter():
    s = scene(bar((2, 1, 1)), build="worker", extrapolate=0.5, threads=7, budget=1e-3)
    sim = Simulation(s)
    message, topology = described(sim)
    resolved = json.loads(message.resolved)
    resolved["solver"] |= {"precision": "mixed", "factor_precision": "float16"}
    message.resolved = json.dumps(resolved)
    sim.engine.assemble()
    assert Assembly(message, topology).matrix(sim.world.x.copy()).tobytes() == sim.system.values.tobytes()


@pytest.mark.parametrize(
    "resolved",
    ["", "[]", "{", '{"object": []}', '{"object": [{"name": "bar"}], "solver": 3}', "[" * 100_000, '{"object": 7}'],
)
def test_what_is_no_scene_is_refused(resolved):
    message, topology = described(simulation(bar()))
    message.resolved = resolved
    with pytest.raises(Refused, match=r"Scene\.resolved"):
        Assembly(message, topology)


def test_no_file_is_read(tmp_path):
    (tmp_path / "springs.txt").write_text("0 1\n")
    springs = {"mass_spring": {"springs": str(tmp_path / "springs.txt"), "stiffness": 10.0}}
    sim = simulation({**bar(young=None), "effects": springs})
    assert not all(e.known_to_workers for e in sim.effects.values())
    with pytest.raises(Refused, match="names a file"):
        Assembly(*described(sim))


def test_an_unknown_effect_is_refused():
    message, topology = described(simulation(bar()))
    resolved = json.loads(message.resolved)
    resolved["object"][0]["effects"] = {"os": {}}
    message.resolved = json.dumps(resolved)
    with pytest.raises(Refused, match="os"):
        Assembly(message, topology)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("rest", b"123"),
        ("rest", np.full((45, 3), np.nan).tobytes()),
        ("tets", np.full(4, 99, np.int32).tobytes()),
        ("tets", np.full(4, -1, np.int32).tobytes()),
        ("tets", np.zeros(4, np.int32).tobytes()),
        ("nodes", 44),
        ("columns", b""),
    ],
)
def test_a_topology_that_does_not_fit_is_refused(field, value):
    message, topology = described(simulation(bar()))
    assert topology.nodes == 45
    setattr(topology, field, value)
    with pytest.raises(Refused):
        Assembly(message, topology)


@pytest.mark.parametrize("x", [np.zeros((44, 3)), np.zeros((45, 2)), np.full((45, 3), np.inf)])
def test_positions_that_do_not_fit_are_refused(x):
    with pytest.raises(ValueError, match="positions"):
        Assembly(*described(simulation(bar()))).matrix(x)


def test_a_grab_is_known_to_the_server_alone():
    sim = simulation(bar(touch={"max_force": 1e4}))
    touch = sim.effects["touch"]
    assert touch.known_to_workers
    touch.push("me", "bar", (2, 0, 0), 0.0, (1, 0, 0), 1.0)
    assert touch.known_to_workers, "a push does not enter the matrix"
    touch.grab("me", "bar", (2, 0, 0), 0.0, (3, 0, 0), 1e3, 10.0, 1e9)
    assert not touch.known_to_workers


class Builders(Inline):
    """Workers that build matrices, in name; keeps what it is sent."""

    def __init__(self, sim: Simulation):
        super().__init__({b.name: sim.system.body_pattern(b.first, b.last) for b in sim.world.bodies})
        self._assembly, self.jobs = Assembly(*described(sim)), []

    def assembles_matrices(self) -> bool:
        return True

    def submit(self, job: Job) -> bool:
        self.jobs.append((job.step, job.positions))
        values = self._assembly.matrix(job.values) if job.positions else job.values
        return super().submit(replace(job, values=values))


@pytest.mark.parametrize("update", ["async", "lockstep-1"])
def test_positions_that_a_grab_overtook_go_to_nobody(update):
    """The grab begins after positions were asked for and before the loop copies them: what is sent is the matrix."""
    solver = {"preconditioner": "cholesky", "update": update, "build": "worker"}
    sim = simulation(bar(touch={"max_force": 1e4}), **solver)
    source = Builders(sim)
    touch, driver = sim.effects["touch"], Driver(sim, source)
    ask, begun, over = driver.snapshots.request, [], []

    def overtaken(t):
        ask(t)
        if sim.engine.step >= 4 and not begun:
            begun.append(sim.engine.step)
            touch.grab("me", "bar", (2, 0, 0), 0.0, (3, 0, 0), 1e3, 10.0, 1e9)
        elif sim.engine.step >= 8 and not over:
            over.append(sim.engine.step)
            touch.release("me", 1)

    driver.snapshots.request = overtaken
    driver.advance(16)
    positions, matrices = ([step for step, alone in source.jobs if alone is kind] for kind in (True, False))
    assert positions[0] < begun[0] and positions[-1] > over[0], "before and after"
    assert [step for step in positions if begun[0] <= step < over[0]] == []
    assert begun[0] < min(matrices) <= over[0]
