# SPDX-License-Identifier: MIT
"""Bodies that touch themselves: momentum of a fork whose arms meet, what carries an arm, what the search costs."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from sim_server.mesh.own_surface import edges_through_triangles
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.contact.bodies import LOCKSTEP, G, Row, times
from tests.bench.contact.ladder import JACOBI, line
from tests.contact.scenes import contact_forces, elastic_forces, floor, fork
from tests.scenes import bar

EDGE, D = 0.01, 0.001  # of cells; thickness [m]
FAR = floor(pose={"translate": [0, -100, 0]})
ROUNDS = 5


def _forked(folder: str, cells: tuple[int, int, int], young: float, **table: Any) -> dict[str, Any]:
    return bar(mesh=fork(Path(folder), cells, EDGE), name="fork", young=young, **table)


def made(
    thing: dict[str, Any], itself: bool = True, gravity: float = 0.0, dt: float = 1 / 60, **table: Any
) -> Simulation:
    contact = {"self": itself, "thickness": D} | table.pop("contact", {})
    effects = {"gravity": {"g": [0, -gravity, 0]}, "contact": contact}
    scene = {"name": "bench", "dt": dt, "effects": effects, "object": [thing], "obstacle": [FAR]} | table
    return Simulation(Scene.model_validate(scene, context={"folder": "."}))


def answers() -> list[Row]:
    """Arms of a free fork driven into each other: momentum, edges through triangles. An arm that rests on the other."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for speed in (1.0, 10.0, 50.0):
            sim = made(_forked(folder, (8, 5, 2), 3e5), contact={"passes": 200}, solver=JACOBI | {"tolerance": 1e-12})
            w, x = sim.world, sim.world.rest
            w.v[:, 1] = np.where(x[:, 0] > 2.1 * EDGE, np.where(x[:, 1] > 2.5 * EDGE, -speed, speed), 0)
            w.v -= w.mass @ w.v / w.mass.sum()
            size, through, touched, driver = float((w.mass * np.linalg.norm(w.v, axis=1)).sum()), 0, 0, Driver(sim)
            surfaces = sim.contact.contact_input().surfaces
            for _ in range(10):
                touched += int(driver.advance(1)["contacts"].max())
                through += len(edges_through_triangles(w.x, surfaces.edge, surfaces.triangle)[0])
            lost = float(abs(w.mass @ w.v).max()) / size if touched else float("inf")
            name = f"arms of a fork meet at {speed:g} m/s each"
            found.append(line(f"{name}: change of momentum over that of the arms", 0, lost, 1e-9))
            found.append(line(f"{name}: edges through triangles, all steps", 0, through, 0.5))
        found.append(_carried(folder))
    return found


def _carried(folder: str) -> Row:
    """The largest force that is left at a free node, over the weight: elastic (reference), gravity, contact."""
    soft = _forked(folder, (8, 5, 2), 4e3, fixed="Y < 0.0001", damping=(20.0, 0.0))
    most = {"passes": 50, "tolerance": 1e-7}
    sim = made(soft, gravity=G, dt=0.02, contact=most, solver=JACOBI | {"tolerance": 1e-12})
    Driver(sim).advance(600)
    w = sim.world
    left = contact_forces(sim) + elastic_forces(sim, 4e3, 0.3) + w.mass[:, None] * (0, -G, 0)
    weight = float(w.mass.sum()) * G
    return line("an arm at rest on the other one: force left at a node over the weight", 0,
                float(abs(left[w.free > 0]).max()) / weight, 1e-5)  # fmt: skip


def cost(steps: int = 30) -> list[Row]:
    """Steps with the key and without it, in turns: nothing near, and an arm at rest by few and by many contacts."""
    found: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        held = {"fixed": f"Y > {0.05 - 1e-4}"}
        swings = {"fixed": "X < 0.0001"}
        cases: dict[str, tuple[dict[str, Any], float]] = {
            "block at rest, 3,000 tets": (bar((10, 5, 10), (0.1, 0.05, 0.1), damping=(5.0, 0.0), **held), 0.01),
            "bar that swings, 3,000 tets": (bar((20, 5, 5), (0.2, 0.05, 0.05), **swings), 0.01),
        }
        for name, cells in (("narrow", (10, 5, 1)), ("wide", (12, 5, 18))):
            table = _forked(folder, cells, 4e3, fixed="Y < 0.0001", damping=(20.0, 0.0))
            cases[f"{name} arm on the other one, at rest"] = (table, 0.02)
        for name, (table, dt) in cases.items():
            drivers = []
            for itself in (False, True):
                drivers.append(Driver(made(table, itself, gravity=G, dt=dt, solver=LOCKSTEP)))
                drivers[-1].advance(200 if "arm" in name else 40)
            rounds = [[d.advance(steps) for d in drivers] for _ in range(ROUNDS)]
            ms = [min(float(np.median(times(r[k], "cpu"))) for r in rounds) for k in range(2)]
            records = np.concatenate([r[1] for r in rounds])
            found.append({
                "case": name, "self contacts": int(records["contacts"].max()),
                "iterations": float(records["iterations"].mean()), "passes": float(records["passes"].mean()),
                "p50 ms": ms[1], "without the key, ms": ms[0], "over without": ms[1] / ms[0],
            })  # fmt: skip
    return found
