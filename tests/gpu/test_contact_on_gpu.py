# SPDX-License-Identifier: MIT
"""Contact with obstacles on a GPU beside the CPU's. Runs where there is a GPU: pytest -m gpu."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.declarations import Declarations
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.contact.scenes import LOCKSTEP, D, block, edge, floor, over, ram, thrust
from tests.contact.test_contact_triangles import SMALL, check, obstacle
from tests.system.server_process import Stage
from tests.system.test_replay_of_a_server import replayed

pytestmark = pytest.mark.gpu

OUT_OF_PASSES = Declarations("kernels/kinds.h").enumeration("Status")["CONTACT"]
TIGHT: dict[str, Any] = {
    "contact": {"thickness": 0.002, "tolerance": 1e-8, "passes": 200},
    "solver": {"preconditioner": "block_jacobi", "tolerance": 1e-10, "max_iterations": 2000},
}


def on(name: str, speed: float = 1.0, **table: Any) -> Simulation:
    """A block that comes down on an obstacle between its nodes."""
    given = SMALL | {"at": (0, 0.5 * D, 0), "velocity": (0.3 * speed, -speed, 0.1 * speed)}
    return over(obstacle(name), **{**given, **table})


CASES: dict[str, Callable[..., Simulation]] = {
    "lands on a corner of a box": lambda **table: on("corner", **table),
    "lands on a rod": lambda **table: on("rod", **table),
    "is thrown onto a ball": lambda **table: on("ball", 8.0, at=(0, 0.06, 0), **table),
    "falls": lambda **table: over(at=(0, 0.02, 0), **table),
    "slides": lambda **table: over(velocity=(2, 0, 0), friction=0.1, **table),
    "tumbles": lambda **table: over(at=(0, 0.05, 0), rotate=(20, 0, 35), velocity=(1, -2, 0), **table),
    "is thrown down": lambda **table: over(at=(0, 0.02, 0), velocity=(0, -10, 0), **table),
    "is thrown down obliquely": lambda **table: over(at=(0, 0.02, 0), velocity=(7, -7, 0), **table),
    "rests with an edge lifted": lambda **table: over(*edge(), **table),
    "is hit from below": lambda **table: over(ram(), floor(), at=(0, 0.02, 0), **table),
}


SENSITIVE = CASES.keys() & {"lands on a corner of a box", "lands on a rod"}  # a CPU alone: 1e-3 m by the tolerance
ON_TRIANGLES = ["lands on a corner of a box", "lands on a rod", "is thrown onto a ball"]


def both(make: Callable[..., Simulation], steps: int, **table: Any) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Returns records (2, steps), of a GPU first, largest difference of x in each step [m], and x of the GPU."""
    sims = [make(device=device, **table) for device in ("gpu", "cpu")]
    drivers, found, apart = [Driver(sim) for sim in sims], [], []
    for _ in range(steps):
        found.append([driver.advance(1)[0] for driver in drivers])
        sims[0].fetch()
        apart.append(np.abs(sims[0].world.x - sims[1].world.x).max())
    return np.array(found).T, np.array(apart), sims[0].world.x


@pytest.mark.parametrize("case", CASES)
def test_steps_are_those_of_the_cpu(case):
    """To the tolerance of contact: what a step leaves of the residual moves a node by micrometres."""
    (g, c), apart, x = both(CASES[case], 40)
    assert g["contacts"].max() > 0 and np.isfinite(x).all()
    if case in SENSITIVE:
        assert apart.max() < 5e-3 and (g["status"] == c["status"]).all(), apart
        return
    assert apart.max() < 2e-5, apart
    assert (g["status"] == c["status"]).all() and (np.abs(g["passes"] - c["passes"]) <= 3).all()
    assert (np.abs(g["contacts"] - c["contacts"]) <= 2).all() and (g["clipped"] == c["clipped"]).all()
    assert (g["factor_step"] == c["factor_step"]).all()
    assert g["work"] == pytest.approx(c["work"], rel=1e-2, abs=1e-4)


@pytest.mark.parametrize("case", ["falls", "slides", "is thrown down", "is hit from below", *ON_TRIANGLES])
def test_tight_tolerances_leave_no_difference(case):
    (g, c), apart, _ = both(CASES[case], 15, **TIGHT)
    assert apart.max() < 1e-8, apart
    assert (g["contacts"] == c["contacts"]).all() and g["contacts"].max() > 0
    assert np.nanmax(g["contact_residual"]) <= 1e-8 and (g["residual"] <= 1e-10).all()


def test_a_block_at_rest_weighs_what_it_weighs():
    sim = over(device="gpu")
    Driver(sim).advance(150)
    sim.engine.run(10)
    records, forces = sim.engine.records_and_reactions()
    weight = 9.81 * float(sim.world.mass.sum())
    assert forces.shape == (10, 1, 6) and records["contacts"][-1] == 25
    assert forces[-1, 0, 1] == pytest.approx(-weight, rel=1e-5)
    rows = sim.contact.contact_input()
    force = sim.world.backend.fetch(rows.force)
    assert force.sum() == pytest.approx(weight, rel=1e-5)


@pytest.mark.parametrize("case", ["slides", "is hit from below", "lands on a rod"])
def test_runs_repeat_to_the_bit(case):
    """Also in batches, whose steps are one graph, and by halves of a step."""

    def run(advance: Callable[[Simulation], None]) -> tuple[bytes, NDArray[Any], bytes]:
        sim = CASES[case](device="gpu", solver={"preconditioner": "block_jacobi"})
        advance(sim)
        records, forces = sim.engine.records_and_reactions()
        sim.fetch()
        return sim.world.x.tobytes() + sim.world.v.tobytes(), records, forces.tobytes()

    def singly(sim: Simulation) -> None:
        for _ in range(41):
            sim.engine.run(1)

    def by_halves(sim: Simulation) -> None:
        for _ in range(41):
            sim.engine.assemble()
            sim.engine.solve()

    first, *others = [run(lambda sim: sim.engine.run(41)), run(singly), run(by_halves)]
    names = ("residual", "contact_residual", "iterations", "passes", "contacts", "work", "status")
    for other in others:
        assert other[0] == first[0] and other[2] == first[2]
        for name in names:
            assert other[1][name].tobytes() == first[1][name].tobytes(), name


@pytest.mark.parametrize("precision", ["mixed", "float32"])
def test_other_precisions_come_near(precision):
    sims = [
        CASES["slides"](device=d, solver={**LOCKSTEP, **s}) for d, s in (("gpu", {"precision": precision}), ("cpu", {}))
    ]
    found = [Driver(sim).advance(30) for sim in sims]
    sims[0].fetch()
    assert np.abs(sims[0].world.x - sims[1].world.x).max() < 1e-3
    assert np.median(found[0]["contacts"]) == np.median(found[1]["contacts"]) and not found[0]["clipped"].any()


def test_points_are_held_back_where_passes_run_out():
    short = {"thickness": 0.002, "passes": 1}
    (g, c), apart, _ = both(CASES["is hit from below"], 3, contact=short)  # later ones use factors of other precisions
    assert g["clipped"].max() > 0 and (g["clipped"] == c["clipped"]).all() and OUT_OF_PASSES in g["status"]
    assert apart.max() < 1e-9  # such steps are not solved: what is left of them depends on the preconditioner


@pytest.mark.parametrize("name", ["corner", "ball", "rod"])
@pytest.mark.parametrize("speed", [1.0, 30.0])
def test_nothing_passes_between_nodes(name, speed):
    hard = SMALL | {"young": 3e5 * max(1, speed / 10) ** 2, "at": (0, 0.05, 0)}
    sim = over(obstacle(name), velocity=(0.1 * speed, -speed, 0.05 * speed), device="gpu", **hard)
    touched = False
    for _ in range(12):
        sim.engine.run(1)
        sim.fetch()
        check(sim, name)
        touched = touched or sim.engine.records()["contacts"].any()
    assert touched and np.isfinite(sim.world.v).all()


def test_triangles_are_held_back_where_passes_run_out():
    """Counted as on the CPU."""
    short = {"thickness": D, "passes": 1, "stiffness": 0.001}
    (g, c), apart, _ = both(lambda **table: on("rod", 10.0, at=(0, 0.05, 0), **table), 2, contact=short)
    assert g["clipped"].max() > 0 and (g["clipped"] == c["clipped"]).all() and apart.max() < 1e-3


def test_a_block_that_a_ball_is_thrust_through_is_held_back_as_on_the_cpu():
    """Passes run out in the first two steps; the body comes back from the state that is taken then."""
    given = {"cells": (3, 3, 3), "size": (0.1, 0.1, 0.1), "young": 1e5, "dt": 0.01, "at": (0, 0.006, 0)}
    solver = TIGHT["solver"]
    (g, c), apart, x = both(lambda **table: over(floor(), thrust(), **given, **table), 8, solver=solver)
    assert (g["status"] == c["status"]).all() and OUT_OF_PASSES in g["status"] and not g["status"][3:].any()
    assert g["clipped"].max() > 0 and (g["clipped"] == c["clipped"]).all()
    assert apart[:2].max() < 1e-6 and apart.max() < 1e-4 and (x[:, 1] > 0).all(), apart


def test_a_factor_learns_of_triangles():
    copies = []
    for device in ("gpu", "cpu"):
        sim = on("ball", device=device, **TIGHT)
        sim.engine.run(4)
        sim.engine.assemble()
        copies.append(sim.engine.factor_matrix(0).copy())
        sim.engine.solve()
    assert np.abs(copies[0] - copies[1]).max() <= 1e-6 * np.abs(copies[1]).max()


@pytest.mark.parametrize("count", [3, 400])
def test_many_bodies(count):
    """Each by itself, with thread blocks of its own or in the pool."""
    objects = [
        block(cells=(1 + k % 2, 1, 1), at=(0.2 * k, 0.003 + 0.001 * (k % 7), 0), name=f"b{k}") for k in range(count)
    ]
    table: dict[str, Any] = {
        "contact": {"thickness": D, "between": False},
        "solver": {"preconditioner": "block_jacobi"},
    }
    made = {d: over(objects=objects, device=d, **table) for d in ("gpu", "cpu")}
    for sim in made.values():
        sim.engine.run(20)
    g, c = (sim.engine.records() for sim in made.values())
    made["gpu"].fetch()
    assert np.abs(made["gpu"].world.x - made["cpu"].world.x).max() < 2e-5
    assert (g["body"] == c["body"]).all() and (np.abs(g["contacts"] - c["contacts"]) <= 2).all()


def test_a_factor_learns_of_contact():
    iterations = {}
    for update in ("never", "lockstep-2", "every-1"):
        solver = {"preconditioner": "cholesky", "update": update}
        sim = over(velocity=(3, 0, 0), solver=solver, cells=(8, 5, 8), device="gpu")
        iterations[update] = Driver(sim).advance(40)["iterations"][15:].mean()
    assert max(iterations["lockstep-2"], iterations["every-1"]) <= 0.6 * iterations["never"], iterations


def test_a_recorded_run_is_the_same_bit_for_bit(tmp_path: Path) -> None:
    scene, log = tmp_path / "slide.toml", tmp_path / "run.mcap"
    scene.write_text(
        """
        dt = 0.01
        [effects]
        gravity = { g = [3, -9.81, 0] }
        contact = true
        [solver]
        preconditioner = "cholesky"
        [[object]]
        name = "block"
        mesh = { bar = [4, 3, 4], size = [0.1, 0.06, 0.1], split = "kuhn" }
        pose = { translate = [0, 0.02, 0] }
        density = 1000
        friction = 0.2
        effects = { corotational = { young = 3e5, poisson = 0.45 } }
        [[obstacle]]
        name = "floor"
        shape = "plane"
        """
    )
    stage = Stage(tmp_path)
    try:
        options = ("--steps", "2000", "--record", str(log), "--workers", "1", "--device", "gpu")
        server = stage.server(scene, *options)
        assert server.wait() == 0, server.output()
    finally:
        stage.close()
    found = replayed(log, 0, timeout=240)
    assert found["same"] and found["steps"] == 2000, found
