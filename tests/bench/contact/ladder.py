# SPDX-License-Identifier: MIT
"""Known answers of contact: what must come out, and what did."""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import meshio
import numpy as np

from sim_server.mesh import bar as bar_mesh
from sim_server.mesh import posed
from sim_server.mesh.surface import surface_triangles
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.contact.bodies import DT, LOCKSTEP, G, Reals, Row, run_with_forces
from tests.contact.scenes import D, block, floor, over
from tests.reference import contact as reference
from tests.reference import shapes

JACOBI = {"preconditioner": "block_jacobi", "max_iterations": 5000}


def line(case: str, known: float, ours: float, bound: float | None) -> Row:
    """Error relative to what is known, absolute where that is 0. bound: of the error; None: there is none."""
    error = abs(ours / known - 1) if known else abs(ours)
    holds = "" if bound is None else "yes" if error <= bound else "**no**"
    return {"case": case, "known": f"{known:.6g}", "ours": f"{ours:.6g}", "error": float(error),
            "at most": "" if bound is None else f"{bound:g}", "holds": holds}  # fmt: skip


def weight(sim: Simulation) -> float:
    return float(sim.world.mass.sum()) * G


def velocity(sim: Simulation) -> Reals:
    mean: Reals = sim.world.mass @ sim.world.v / sim.world.mass.sum()
    return mean


def residual() -> list[Row]:
    """With the law written in NumPy."""
    sim = over(solver=JACOBI, velocity=(1, -3, 0), at=(0, 0.02, 0))
    ratios = []
    for _ in range(40):
        made, record = reference.step(sim)
        if record["passes"] and record["contact_residual"] > 1e-5:
            ratios.append(made.residual / record["contact_residual"])
    worst = max(ratios, key=lambda r: abs(r - 1))
    return [line("residual with the law in NumPy over that in the record, worst of 40 steps", 1, float(worst), 0.2)]


def rest() -> list[Row]:
    sim = over()
    Driver(sim).advance(150)
    _, forces = run_with_forces(sim, 1)
    rows = sim.contact.contact_input()
    on = (rows.force > 0) & (rows.corner[:, 1] < 0)
    low = sim.world.x[rows.corner[on, 0], 1]
    apart = abs(low - (D - rows.force[on] / rows.stiffness[on])).max() / D
    return [
        line("block at rest: force on the floor [N]", weight(sim), float(-forces[0, 1]), 1e-5),
        line("block at rest: distance - (thickness - force / stiffness), over the thickness", 0, float(apart), 1e-5),
        line("block at rest: least distance over the thickness", 1, float(low.min() / D), 0.1),
        line("block at rest: largest speed [m/s]", 0, float(abs(sim.world.v).max()), 1e-8),
    ]


def inclines() -> list[Row]:
    found = []
    for degrees in (-5.0, -0.5, 0.5, 5.0):
        angle = np.arctan(0.5) + np.radians(degrees)
        sim = over(gravity=(G * np.sin(angle), -G * np.cos(angle), 0))
        driver = Driver(sim)
        driver.advance(90 if degrees < 0 else 30)
        x, v = sim.world.x.mean(axis=0), velocity(sim)[0]
        driver.advance(60)
        name = f"slope at {degrees:+g} degrees from the limit of friction 0.5: "
        if degrees < 0:
            creep = 1e3 * float(np.linalg.norm(sim.world.x.mean(axis=0) - x))
            found.append(line(name + "creep [mm/s]", 0, creep, 1e-3))
        else:
            known = float(G * (np.sin(angle) - 0.5 * np.cos(angle)))
            found.append(line(name + "acceleration [m/s2]", known, float(velocity(sim)[0] - v), 0.04))
    return found


def stops() -> list[Row]:
    found = []
    for friction in (0.1, 0.5):
        sim = over(floor(friction), velocity=(1, 0, 0), friction=friction)
        x = sim.world.x.mean(axis=0)
        Driver(sim).advance(120)
        known = 1 / (2 * friction * G) - DT / 2
        ours = float((sim.world.x.mean(axis=0) - x)[0])
        found.append(line(f"block at 1 m/s, friction {friction:g}: way until it stops [m]", known, ours, 5e-3))
    return found


def impacts() -> list[Row]:
    found = []
    for speed in (1.0, 10.0, 50.0):
        sim = over(floor(0.0), velocity=(0.3 * speed, -speed, 0), friction=0.0, at=(0, 0.02, 0),
                   solver=LOCKSTEP | {"tolerance": 1e-8})  # fmt: skip
        before = sim.world.mass @ sim.world.v
        _, forces = run_with_forces(sim, 30)
        after = sim.world.mass @ sim.world.v
        known = float(after[1] - before[1] + weight(sim) * 30 * DT)
        name = f"oblique impact without friction at {speed:g} m/s: "
        found.append(line(name + "momentum along the floor [kg m/s]", float(before[0]), float(after[0]), 1e-6))
        found.append(line(name + "impulse of the floor [kg m/s]", known, float(-forces[:, 1].sum() * DT), 1e-6))
    return found


def energies(steps: int = 10_000) -> list[Row]:
    """Kinetic, elastic, gravity and what contacts store."""
    starts: dict[str, dict[str, Any]] = {
        "slides": {"velocity": (3, 0, 0)}, "tumbles": {"at": (0, 0.1, 0), "rotate": (30, 20, 40)},
        "is thrown": {"velocity": (20, -20, 0), "at": (0, 0.1, 0), "rotate": (10, 0, 40)},
    }  # fmt: skip
    found = []
    for name, start in starts.items():
        sim = over(**({"at": (0, 0.02, 0)} | start))
        sim.engine.loop.energy_every = 1
        driver, rows, total = Driver(sim), sim.contact.contact_input(), []
        for _ in range(steps):
            r = driver.advance(1)[0]
            stored = (rows.force**2 + (rows.traction**2).sum(axis=1)) @ (0.5 / np.maximum(rows.stiffness, 1e-300))
            total.append(float(r["kinetic"] + r["elastic"] + r["gravity"] + stored))
        above = max(0.0, (max(total) - total[0]) / abs(total[0]))
        found.append(line(f"block that {name}, {steps} steps: energy above that of the start", 0, above, 1e-6))
    return found


def preconditioners() -> list[Row]:
    """The same motion, whatever solves it."""
    names = {
        "none": {"preconditioner": "none"}, "ssor": {"preconditioner": "ssor"}, "factor of each step": _lockstep(1),
        "factor 10 to 19 steps old": _lockstep(10), "first factor": {"preconditioner": "cholesky", "update": "never"},
    }  # fmt: skip
    found = []
    for start, table in {
        "slides": {"velocity": (1, 0, 0)},
        "hits": {"velocity": (1, -3, 0), "at": (0, 0.02, 0)},
    }.items():

        def end(solver: dict, table: dict[str, Any] = table) -> Reals:
            contact = {"thickness": D, "tolerance": 1e-8, "passes": 200}
            sim = over(contact=contact, solver=solver | {"tolerance": 1e-9, "max_iterations": 5000}, **table)
            Driver(sim).advance(40)
            x: Reals = sim.world.x.copy()
            return x

        first = end({"preconditioner": "block_jacobi"})
        for name, solver in names.items():
            apart = float(abs(end(solver) - first).max())
            found.append(line(f"block that {start}: {name} against block Jacobi, positions [m]", 0, apart, 1e-6))
    return found


def _lockstep(latency: int) -> dict[str, Any]:
    return {"preconditioner": "cholesky", "update": f"lockstep-{latency}"}


def turned() -> list[Row]:
    """The floor, the block, its velocity and gravity."""
    turn = (20.0, -35.0, 50.0)

    def there(v: tuple) -> list[float]:
        return [float(c) for c in posed(np.array([v], float), turn, (0, 0, 0))[0]]

    straight = over(velocity=(1, -1, 0.3), at=(0, 0.01, 0))
    other = over(
        floor(pose={"rotate": list(turn)}), objects=[block(rotate=turn, at=there((0, 0.01, 0)))],
        velocity=there((1, -1, 0.3)), gravity=there((0, -9.81, 0)),
    )  # fmt: skip
    a, b = (int(Driver(sim).advance(60)["iterations"].sum()) for sim in (straight, other))
    apart = float(abs(other.world.x - posed(straight.world.x, turn, (0, 0, 0))).max())
    return [
        line("scene turned by (20, -35, 50) degrees: iterations of 60 steps", a, b, 0.2),
        line("scene turned: positions [m]", 0, apart, 2e-5),
    ]


CASES: dict[str, Callable[[], list[Row]]] = {
    "residual": residual, "rest": rest, "inclines": inclines, "stops": stops, "impacts": impacts,
    "energies": energies, "preconditioners": preconditioners, "turned": turned,
}  # fmt: skip


# --- nodes on the wrong side ------------------------------------------------------------------------------------------

SPEEDS, TIME_STEPS = (1.0, 3.0, 10.0, 30.0, 100.0), (0.005, 1 / 60, 0.03)
SMALL: dict[str, Any] = {"cells": (2, 2, 2), "size": (0.1, 0.1, 0.1)}
SAMPLES = 1500  # of the path of a node in a step
OBSTACLES: dict[str, Row] = {
    "plate of 2 mm": {"shape": "box", "size": [4, 0.002, 4], "pose": {"translate": [0, -0.001, 0]}},
    "plate of 20 mm": {"shape": "box", "size": [4, 0.02, 4], "pose": {"translate": [0, -0.01, 0]}},
    "ball of 50 mm radius": {"shape": "sphere", "radius": 0.05, "pose": {"translate": [0.05, -0.06, 0.05]}},
    "edge of a box": {
        "shape": "box",
        "size": [0.1, 0.1, 1],
        "pose": {"translate": [0.05, -0.1, 0.05], "rotate": [0, 0, 45]},
    },
    "rod of 10 mm radius": {
        "shape": "capsule",
        "radius": 0.01,
        "length": 1,
        "pose": {"translate": [0.05, -0.05, 0.05], "rotate": [90, 0, 0]},
    },
    "grid of distances": {"shape": "grid", "spacing": 0.005, "pose": {"translate": [0.05, -0.08, 0.05]}},
}


def tunnelling(name: str, dt: float, speed: float) -> Row:
    """A small block thrown at an obstacle: nodes whose path leads into it in some step."""
    with TemporaryDirectory() as folder:
        table = {"name": "it"} | OBSTACLES[name]
        if table["shape"] == "grid":
            table |= {"file": _closed_surface(Path(folder))}
        sim = over(table, velocity=(0.2 * speed, -speed, 0), dt=dt, at=(0, 0.05, 0), **SMALL)
    rows = sim.contact.contact_input()
    nodes = np.unique(rows.corner[: rows.body_start[-1], 0])
    pose, wrong, clipped = rows.obstacles.begin[0].copy(), 0, 0
    part = np.linspace(0, 1, SAMPLES)[:, None, None]
    for _ in range(int(0.05 / speed / dt) + 15):
        before = sim.world.x[nodes].copy()
        sim.engine.run(1)
        clipped += int(sim.engine.records()["clipped"].sum())
        path = (before + part * (sim.world.x[nodes] - before)).reshape(-1, 3)
        local = (path - pose[:3]) @ shapes.rotation(pose[3:])
        inside = (_distance(table, rows.obstacles, local) < -1e-9).reshape(SAMPLES, -1).any(axis=0)
        wrong = max(wrong, int(inside.sum()))
    return {"obstacle": name, "dt ms": 1e3 * dt, "speed": speed, "wrong": wrong, "clipped": clipped}


def _distance(table: Row, given: Any, local: Reals) -> Reals:
    size = given.size[0]
    if table["shape"] == "box":
        return shapes.box(local, size[:3])
    if table["shape"] == "sphere":
        return shapes.sphere(local, size[0])
    if table["shape"] == "capsule":
        return shapes.capsule(local, size[0], size[1])
    values = given.grid[given.place[0] :][: int(np.prod(given.cells[0]))].reshape(given.cells[0])
    return shapes.grid(local, size[:3], float(size[3]), values)


def _closed_surface(folder: Path) -> str:
    """Of a turned box of 0.1 x 0.08 x 0.1 m."""
    mesh = bar_mesh((2, 2, 2), (0.1, 0.08, 0.1), "kuhn")
    x = posed(mesh.rest - np.array([0.05, 0.04, 0.05]), (20, 10, 40), (0, 0, 0))
    file = folder / "surface.stl"
    meshio.Mesh(x, [("triangle", surface_triangles(mesh.tets))]).write(file)
    return str(file)
