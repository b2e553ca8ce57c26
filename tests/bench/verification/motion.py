# SPDX-License-Identifier: MIT
"""`bench verification`: order in time, what is conserved, and one trajectory whatever the preconditioner."""

from typing import Any

import numpy as np

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.verification.row import Row, absolute, relative
from tests.integrators.test_conserved import SCHEMES, TIGHT, energy, spin
from tests.integrators.test_time_order import ORDER, orders
from tests.physics.test_cantilever import lowest_mode
from tests.scenes import bar, simulation

PRECONDITIONERS = {
    "no preconditioner": {"preconditioner": "none"},
    "Jacobi": {"preconditioner": "jacobi"},
    "SSOR": {"preconditioner": "ssor"},
    "a factor of each step": {"preconditioner": "cholesky", "update": "every-1"},
    "the first step's factor, warped": {"preconditioner": "cholesky", "update": "never"},
    "the first step's factor, not warped": {"preconditioner": "cholesky", "update": "never", "warp": False},
}


def time_orders(quick: bool) -> list[Row]:
    """A beam let go bent by a tenth of its length; Newton-Raphson to 1e-9."""
    rows = []
    for scheme, order in ORDER.items():
        found = orders(scheme, 40)[-1]
        case, source = f"{scheme}, Newton-Raphson: order in time", "Hairer and Wanner; steps halved, 3200 of newmark"
        rows.append(absolute(f"{case}, x", order, found[0], 0.1, source))
        rows.append(absolute(f"{case}, v", order, found[1], 0.1, source))
    return rows


def free_bar(scheme: str = "backward_euler", young: float = 2e5, **integrator) -> Simulation:
    table = {"scheme": scheme, "linearizations": 30, "tolerance": 1e-9} | integrator
    return simulation(bar((4, 2, 2), (2, 1, 1), young=young), dt=0.02, integrator=table, **TIGHT)


def momentum(quick: bool) -> list[Row]:
    rows = []
    for scheme in SCHEMES:
        sim = free_bar(scheme, linearizations=1)
        sim.world.v[:] = np.random.default_rng(0).normal(size=sim.world.v.shape)
        before, whole = (
            sim.world.mass @ sim.world.v,
            np.linalg.norm(sim.world.mass[:, None] * sim.world.v, axis=1).sum(),
        )
        sim.engine.run(20 if quick else 200)
        lost = float(np.linalg.norm(sim.world.mass @ sim.world.v - before) / whole)
        rows.append(
            Row(
                f"{scheme}: momentum of a free body lost, over the sum of m times speed", 0, lost, lost, 1e-12, "Newton"
            )
        )
    rate, dt = 5.0, 0.02
    sim, theta = free_bar(young=1e9), np.arctan(rate * dt)
    centre = sim.world.mass @ sim.world.x / sim.world.mass.sum()
    sim.world.v[:] = np.cross([0.0, 0.0, rate], sim.world.x - centre)
    before = spin(sim)[2]
    sim.engine.run(20)
    for _ in range(19):
        theta = np.arctan(np.sin(theta) / (2 - np.cos(theta)))
    expected, source = 1 - np.sin(theta) / (rate * dt), "chords: tan θ' = sin θ / (2 - cos θ), 20 steps at ω h = 0.1"
    case = "backward_euler, Newton-Raphson: angular momentum lost by a stiff spinning body"
    return [*rows, relative(case, float(expected), 1 - spin(sim)[2] / before, 0.01, source)]


def energies(quick: bool) -> list[Row]:
    """Rises without load; what a mode has left."""
    sim, random = free_bar(), np.random.default_rng(1)
    sim.world.x += 0.02 * random.normal(size=sim.world.x.shape)
    sim.world.v[:] = random.normal(size=sim.world.v.shape)
    history = [energy(sim)]
    for _ in range(20 if quick else 100):
        sim.engine.run(1)
        history.append(energy(sim))
    rise = max(float(np.diff(history).max() / history[0]), 0.0)
    rows = [
        Row(
            "backward_euler: largest rise of energy in a step, without load",
            0,
            rise,
            rise,
            1e-9,
            "of the scheme: it dissipates",
        )
    ]

    def beam(scheme: str, dt: float) -> Simulation:
        return simulation(
            bar((6, 1, 1), (3, 0.5, 0.5), young=1e5, fixed="X < 0.01"), dt=dt, integrator={"scheme": scheme},
            **TIGHT | {"tolerance": 1e-12},
        )  # fmt: skip

    for scheme in ("newmark", "bdf2"):
        left = hanging_and_kicked(scheme, 5 if quick else 20)
        case = f"{scheme}, one linearization: energy of a kicked bar under tension, rise over the kick's"
        rows.append(Row(case, 0, left, left, 1e-9, "the matrix is at least as stiff as the forces"))
    w, shape = lowest_mode(beam("backward_euler", 0.01))
    for scheme, left, source in (
        ("backward_euler", 1.09**-84, "(1 + (ω h)²) to the power -84"), ("newmark", 1.0, "trapezoidal rule"),
    ):  # fmt: skip
        sim = beam(scheme, 0.3 / w)
        sim.world.x += 1e-7 * shape / np.abs(shape).max()
        before = energy(sim)
        sim.engine.run(84)
        case = f"{scheme}: energy that one mode has left after four periods at ω h = 0.3"
        rows.append(relative(case, left, energy(sim) / before, 0.01 if left < 1 else 1e-6, source))
    return rows


def hanging_and_kicked(scheme: str, seconds: int) -> float:
    """Largest rise within a second, over the energy of the kick; a bar stretched by its weight, dt 20 ms."""

    def hanging(damping: float, dt: float, **more: Any) -> Simulation:
        table = bar((4, 1, 1), (4, 1, 1), young=2e5, poisson=0.45, fixed="X < 0.01", damping=(damping, 0))
        return simulation(table, gravity=(9.81, 0, 0), dt=dt, **TIGHT | more)

    still = hanging(5.0, 0.1)
    still.engine.run(300)
    sim = hanging(0.0, 0.02, integrator={"scheme": scheme})
    sim.world.x[:] = still.world.x
    sim.world.v[:] = 1e-3 * sim.world.free[:, None] * np.random.default_rng(0).normal(size=sim.world.x.shape)
    history = [energy(sim)]
    kick = sim.kinetic_energy()
    for _ in range(seconds):
        sim.engine.run(50)
        history.append(energy(sim))
    return max(float(np.diff(history).max() / kick), 0.0)


def preconditioners(quick: bool) -> list[Row]:
    """Largest difference of positions at the end to block Jacobi's, over the length."""
    ends = {}
    for name, choice in {"block Jacobi": {"preconditioner": "block_jacobi"}, **PRECONDITIONERS}.items():
        sim = simulation(
            bar((8, 2, 2), (4, 1, 1), young=1e6, fixed="X < 0.01"), gravity=(0, -9.81, 0), dt=0.02, tolerance=1e-10,
            max_iterations=5000, factor_precision="float64", **choice,
        )  # fmt: skip
        if (Driver(sim).advance(10 if quick else 50)["status"] != 0).any():
            raise ArithmeticError(f"{name}: not converged")
        ends[name] = sim.world.x.copy()
    rows = []
    for name in PRECONDITIONERS:
        off = float(np.abs(ends[name] - ends["block Jacobi"]).max() / 4)
        rows.append(Row(f"same trajectory with {name}", 0, off, off, 1e-8, "block Jacobi, tolerance 1e-10"))
    return rows
