# SPDX-License-Identifier: MIT
"""Elastic bodies whose contact is known in closed form: a bar thrown at a wall, Hertz, a belt round a cylinder."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.mesh import bar as bar_mesh
from tests.bench.contact.bodies import LOCKSTEP, Row, run_with_forces
from tests.bench.contact.ladder import line
from tests.contact.scenes import over
from tests.scenes import bar, mesh_file

Reals = NDArray[np.float64]

DENSITY = 1000.0  # kg/m3


def _bar_at_a_wall(cells: int, steps_to_cross: int = 100) -> dict[str, Any]:
    """Known and computed contact time, force and speed afterwards, and the curve of the force."""
    young, length, side, speed, away = 1e6, 1.0, 0.1, 0.1, 1e-4
    wave = (young / DENSITY) ** 0.5
    dt, lasts = length / wave / steps_to_cross, 2 * length / wave
    wall = {"name": "wall", "shape": "plane", "friction": 0.0, "pose": {"rotate": [0, 0, -90]}}
    body = bar((cells, 1, 1), (length, side, side), young=young, poisson=0.0, friction=0.0)
    body["pose"] = {"translate": [1.1 * away, 0, 0]}
    sim = over(wall, objects=[body], gravity=(0, 0, 0), dt=dt, velocity=(-speed, 0, 0), contact={"thickness": away})
    records, forces = run_with_forces(sim, int(1.3 * lasts / dt))
    time, force = records["time"], -forces[:, 0]
    plateau = wave * DENSITY * speed * side**2
    touched = time[force > plateau / 2]
    within = (time > touched[0] + 0.2 * lasts) & (time < touched[0] + 0.8 * lasts)
    return {
        "lasts": (lasts, float(touched[-1] - touched[0] + dt)), "force": (plateau, float(force[within].mean())),
        "speed": (speed, float(sim.world.mass @ sim.world.v[:, 0] / sim.world.mass.sum())),
        "time": ((time - touched[0]) / lasts).tolist(), "curve": (force / plateau).tolist(),
    }  # fmt: skip


def bar_answers(cells: int = 100) -> list[Row]:
    """Of a bar of 1 x 0.1 x 0.1 m, Poisson's ratio 0, at 0.1 m/s."""
    found, name = _bar_at_a_wall(cells), f"bar thrown at a wall, {cells} cells along it, steps of L / (100 c): "
    return [
        line(name + "contact time [s]", *found["lasts"], 0.05),
        line(name + "force while it lasts [N]", *found["force"], 0.05),
        line(name + "speed afterwards [m/s]", *found["speed"], None),
    ]


def wall(cells: int) -> list[Row]:
    """Curves of the force, at two numbers of cells."""
    found = []
    for n in (cells // 4, cells):
        made = _bar_at_a_wall(n)
        found.append({"cells": n, "time over 2 L/c": made["time"], "force over rho c v S": made["curve"]})
    return found


def hertz(cells: int, kappa: float = 100.0) -> list[Row]:
    """A rigid ball of 0.1 m radius pressed on a block of 0.6 x 0.3 x 0.6 m whose cells are small in the middle."""
    young, poisson, radius = 1e5, 0.3, 0.1
    size, count = np.array([0.6, 0.3, 0.6]), (cells, cells // 2, cells)
    mesh = bar_mesh(count, tuple(size), "kuhn")
    u = 2 * mesh.rest / size - 1
    u[:, 1] = mesh.rest[:, 1] / size[1] - 1  # 0 at the top
    rest = 0.5 * size * _graded(u) * np.array([1, 2, 1])
    half_width = float(0.3 * _graded(np.array([2 / cells]))[0])  # of a cell at the middle
    thickness = 0.1 * half_width
    found: list[Row] = []
    with TemporaryDirectory() as folder:
        body = bar(mesh=mesh_file(Path(folder), rest, mesh.tets), young=young, poisson=poisson, friction=0.0,
                   fixed=f"Y < {-size[1] + 1e-4}", damping=(2.0, 0.0))  # fmt: skip
        depths = (0.002, 0.004, 0.006)
        keys = [{"time": 0.0, "translate": [0, radius + thickness, 0]}]
        keys += [{"time": 1.0 + k, "translate": [0, radius + thickness - deep, 0]} for k, deep in enumerate(depths)]
        ball = {"name": "ball", "shape": "sphere", "radius": radius, "friction": 0.0, "keyframes": keys}
        sim = over(
            ball, objects=[body], gravity=(0, 0, 0), dt=0.1, contact={"thickness": thickness, "stiffness": kappa},
            solver=LOCKSTEP | {"update": "lockstep-1"},
        )  # fmt: skip
        rows = sim.contact.contact_input()
        for deep in depths:
            _, forces = run_with_forces(sim, 10)
            touch = rows.corner[rows.force > 0, 0]
            a = (radius * deep) ** 0.5
            found.append({
                "tets": len(mesh.tets), "depth mm": 1e3 * deep, "cells across a": a / half_width,
                "force N": float(forces[-1, 1]), "Hertz N": 4 / 3 * young / (1 - poisson**2) * radius**0.5 * deep**1.5,
                "a mm": 1e3 * float(np.linalg.norm(sim.world.x[touch][:, [0, 2]], axis=1).max()), "Hertz a mm": 1e3 * a,
            })  # fmt: skip
    for row in found:
        row["force over Hertz"] = row["force N"] / row["Hertz N"]
    return found


def _graded(u: Reals) -> Reals:
    """Maps -1 to 1 on itself, with small cells at 0."""
    return np.asarray(0.125 * u + 0.875 * u**3)


def belt(friction: float, turned: float = 2.0, cells: int = 32) -> Row:
    """A belt over the upper half of a cylinder, its ends held, tightened by raising the cylinder, which then turns.

    The force on the cylinder is the sum of the tensions of both ends, its torque their difference times the radius of
    the middle of the belt.
    """
    radius, thick, wide, tail, dt = 0.05, 0.002, 0.01, 0.04, 0.01
    d = 0.1 * thick
    inner = radius + d
    arc = np.pi * (inner + thick / 2)
    along = 2 * round(cells * tail / arc) + cells
    mesh = bar_mesh((along, 1, 2), (along, thick, wide), "kuhn")
    first = (along - cells) / 2
    s, r, z = mesh.rest[:, 0] - first, inner + mesh.rest[:, 1], mesh.rest[:, 2] - wide / 2
    angle, below = np.pi * np.clip(s / cells, 0, 1), np.maximum(np.maximum(-s, s - cells), 0) * arc / cells
    rest = np.column_stack([-r * np.cos(angle), r * np.sin(angle) - below, z])
    lift, pause, end = 0.003, 0.5, 2.5
    keys: list[Row] = [
        {"time": 0.0, "translate": [0, 0, 0], "rotate": [90, 0, 0]},
        {"time": 0.3, "translate": [0, lift, 0], "rotate": [90, 0, 0]},
        {"time": pause, "translate": [0, lift, 0], "rotate": [90, 0, 0]},
        {"time": end, "translate": [0, lift, 0], "rotate": [90, 0, -np.degrees(turned)]},
    ]
    cylinder = {"name": "cylinder", "shape": "capsule", "radius": radius, "length": 0.2, "friction": friction}
    with TemporaryDirectory() as folder:
        low = float(rest[:, 1].min())
        body = bar(mesh=mesh_file(Path(folder), rest, mesh.tets), young=1e7, poisson=0.0, friction=friction,
                   fixed=f"Y < {low + 1e-4}", damping=(5.0, 0.0))  # fmt: skip
        sim = over(cylinder | {"keyframes": keys}, objects=[body], gravity=(0, 0, 0), dt=dt, contact={"thickness": d})
        run_with_forces(sim, int((end - 0.5) / dt))
        records, forces = run_with_forces(sim, int(0.4 / dt))
    both = -forces[:, 1].mean()
    difference = abs(forces[:, 5].mean()) / (inner + thick / 2)
    high, low = (both + difference) / 2, (both - difference) / 2
    return {
        "friction": friction, "T1 N": float(high), "T2 N": float(low), "e^(mu pi)": float(np.exp(np.pi * friction)),
        "T1 / T2": float(high / low), "error": float(high / low / np.exp(np.pi * friction) - 1),
        "steps not converged": int((records["status"] != 0).sum()),
    }  # fmt: skip
