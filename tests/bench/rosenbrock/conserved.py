# SPDX-License-Identifier: MIT
"""What should stay: the energy of an undamped beam, the momenta of a free body."""

import numpy as np

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.rosenbrock.bars import (
    BDF2,
    EULER,
    NEWMARK,
    ROS2_FACTOR,
    ROS2_ITERATE,
    Bar,
    Method,
    Reals,
    Row,
    Start,
    energy,
    load,
    momenta,
    run,
    thrown,
)

TIME_STEPS = (0.005, 0.01, 0.02)  # s
FREE_TIME_STEPS = (0.01, 0.02)  # s
LATENCIES = (1, 5, 10)
UNDAMPED = (EULER, ROS2_ITERATE, ROS2_FACTOR.aged(10))
NEWTON = {"linearizations": 10}
FREE = (
    EULER, NEWMARK, BDF2, Method("backward Euler, Newton", NEWTON),
    Method("newmark, Newton", {"scheme": "newmark", **NEWTON}), ROS2_ITERATE,
    *(ROS2_FACTOR.aged(latency) for latency in LATENCIES),
)  # fmt: skip


def _noting(energies: list[float]) -> Start:
    def start(sim: Simulation) -> None:
        energies.append(energy(sim))

    return start


def undamped(tets: int, device: str, dt: float, seconds: float) -> list[Row]:
    """The beam let go from horizontal without damping: kinetic energy of the last quarter over that of the first."""
    found: list[Row] = []
    for method in UNDAMPED:
        at_start: list[float] = []
        one = run(Bar(tets, damping=0.0), method, dt, seconds, device, _noting(at_start), frames=False)
        quarter = len(one.records) // 4
        kinetic = one.records["kinetic"]
        found.append({
            "device": device, "dt ms": 1e3 * dt, "method": method.name,
            "last over first quarter": float(kinetic[-quarter:].mean() / kinetic[:quarter].mean()),
            "change of energy": (energy(one.sim) - at_start[0]) / float(kinetic.max()),
            "holds": "yes" if one.well else "no", "by factor": one.share("FACTOR"), "euler": one.share("EULER"),
        })  # fmt: skip
    return found


def _tumbling(x: Reals) -> Reals:
    """Turns about an axis across, vibrates along and moves off: 1 m/s, 2 rad/s, a tenth of the length a second."""
    from_middle = x - x.mean(axis=0)
    stretching = from_middle * [0, 0, 0.2]
    return np.cross([2.0, 0.6, 0.4], from_middle) + stretching + [1.0, 0, 0]


def free(tets: int, device: str, dt: float, seconds: float) -> list[Row]:
    """A bar that nothing holds: largest change of linear and angular momentum, over the values at the start."""
    found: list[Row] = []
    bar = Bar(tets, damping=0.0, gravity=False, held=False)
    for method in FREE:
        sim = load(bar, method, dt, device)
        thrown(_tumbling)(sim)
        linear, angular, first = _drift(sim, method, round(seconds / dt))
        found.append({
            "device": device, "dt ms": 1e3 * dt, "method": method.name, "linear": linear, "angular": angular,
            "energy at the end": energy(sim) / first, "latency": method.latency,
        })  # fmt: skip
    return found


def _drift(sim: Simulation, method: Method, steps: int) -> tuple[float, float, float]:
    """Largest changes, relative; and the energy at the start [J]."""
    driver, first = Driver(sim), energy(sim)
    start = momenta(sim)
    seen = []
    driver.step_with_fresh_factors()
    while sim.engine.step < steps:
        driver.advance(min(5, steps - sim.engine.step))
        seen.append(momenta(sim))
    drifts = [max(np.linalg.norm(m[k] - start[k]) for m in seen) / np.linalg.norm(start[k]) for k in range(2)]
    return float(drifts[0]), float(drifts[1]), first
