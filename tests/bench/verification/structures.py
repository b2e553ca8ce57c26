# SPDX-License-Identifier: MIT
"""`bench verification`: rods in objects and membranes on them, each against a closed form."""

import tempfile
from pathlib import Path

import numpy as np

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.verification.row import Row, relative
from tests.effects.hollow import hollow, sphere
from tests.scenes import bar, scene

STATIC = {"scheme": "quasi_static", "linearizations": 40}
FRESH = {"preconditioner": "cholesky", "update": "every-1", "tolerance": 1e-9}
G, RADIUS = 9.81, 0.02


def rods(quick: bool) -> list[Row]:
    """A needle in a very soft bar, clamped at one end, that sags by its weight; and a rod that strengthens a bar."""
    cells, young, density = 2 if quick else 4, 1e9, 100.0
    given = bar((10 * cells, cells, cells), (2, 0.2, 0.2), density=1e-9, young=1e-2, poisson=0.0, fixed="X < 0.501")
    given["effects"]["rod"] = {
        "path": [[0, 0.11, 0.1], [2, 0.11, 0.1]], "young": young, "radius": RADIUS, "density": density
    }  # fmt: skip
    needle = Simulation(scene(given, dt=1.0, gravity=(0, 0, -G), integrator=STATIC, **FRESH))
    Driver(needle).advance(1)
    end = np.abs(needle.world.rest[:, 0] - 2) < 1e-6
    mass = needle.world.mass * end
    sag = -(mass @ (needle.fetch().x - needle.world.rest)[:, 2]) / mass.sum()  # at the last point, by its weights
    pressed = density * G * np.pi * RADIUS**2 * 1.5**4 / (8 * young * np.pi * RADIUS**4 / 4)
    given = bar((16, 2, 2), (4, 0.5, 0.5), poisson=0.0, density=1000)
    given["effects"] |= {
        "rod": {"path": [[0, 0.24, 0.26], [4, 0.24, 0.26]], "young": 0.25e5 / (np.pi * RADIUS**2), "radius": RADIUS},
        "traction": {"where": "X > 3.99", "force": [500, 0, 0]},
        "fixed": [{"where": "X < 0.01", "along": "x"}, {"where": "true", "along": ["y", "z"]}],
    }
    mixed = Simulation(scene(given, dt=1.0, integrator=STATIC, tolerance=1e-9, max_iterations=5000))
    Driver(mixed).advance(1)
    x = mixed.fetch().x[:, 0]
    ends = [x[np.abs(mixed.world.rest[:, 0] - at) < 1e-6].mean() for at in (1, 2)]
    return [
        relative("rod in a soft bar: sag [m]", pressed, sag, 0.05 if quick else 0.01, "w L^4 / (8 E I)"),
        relative("rod in a bar: stretch of 1 m [m]", 500 / (2 * 0.25e5), ends[1] - ends[0] - 1, 0.01,
                 "rule of mixtures"),
    ]  # fmt: skip


def membranes(quick: bool) -> list[Row]:
    """A balloon."""
    young, thickness, inner, stretch = 1e5, 0.01, 0.9, 1.1
    where = f"X*X + Y*Y + Z*Z < {(inner + 1e-3) ** 2}"
    rubber = {"young": young, "poisson": 0.5, "thickness": thickness, "where": where}
    pressure = 2 * young / 3 * thickness / inner * (1 / stretch - 1 / stretch**7)
    with tempfile.TemporaryDirectory() as folder:
        given = hollow(Path(folder), {"where": where, "pressure": pressure}, sphere(8 if quick else 16, inner, 1.0))
        given["effects"] |= {
            "corotational": {"young": 1.0, "poisson": 0.0}, "membrane": rubber,
            "fixed": [{"where": f"abs({axis}) < 1e-6", "along": axis.lower()} for axis in "XYZ"],
        }  # fmt: skip
        balloon = Simulation(scene(given, dt=1.0, integrator=STATIC, **FRESH))
    Driver(balloon).advance(1)
    wall = np.linalg.norm(balloon.world.rest, axis=1) < inner + 1e-3
    wide = np.linalg.norm(balloon.fetch().x[wall], axis=1).mean() / inner
    return [
        relative("balloon: stretch - 1", stretch - 1, wide - 1, 0.08 if quick else 0.03,
                 "p = 2 mu t / R (1 / s - 1 / s^7)"),
    ]  # fmt: skip


CASES = [rods, membranes]
