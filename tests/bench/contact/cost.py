# SPDX-License-Identifier: MIT
"""What contact costs: iterations and processor time of steps, by what happens, preconditioner and stiffness."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.contact.bodies import (
    DT,
    IMPACT,
    LOCKSTEP,
    REST,
    SIZE,
    Row,
    Situation,
    milliseconds,
    of_times,
    pillar,
    several,
    solvers,
    thickness,
    times,
)
from tests.contact.scenes import block, over
from tests.scenes import scene

AT = 6  # steps from the first contact on that are the impact


def begun(sim: Simulation) -> Driver:
    """With factors from the first step on."""
    driver = Driver(sim)
    if driver.wants_factors:
        driver.step_with_fresh_factors()
    else:
        driver.advance(1)
    return driver


def rows(tets: int, kappa: float, situation: Situation, short: bool = False, device: str = "cpu") -> list[Row]:
    """A row of each preconditioner; of an impact three: before, at and after it."""
    found: list[Row] = []
    for name, solver in solvers(tets).items():
        driver = begun(situation.simulation(tets, solver, kappa, device=device))
        driver.advance(situation.skipped // (6 if short else 1))
        records = driver.advance(10 if short else situation.steps)
        for phase, part in _phases(situation, records).items():
            found.append({
                "device": device, "tets": tets, "kappa": kappa, "situation": phase, "preconditioner": name,
                "steps": len(part), "contacts": int(part["contacts"].max()),
                "iterations": float(part["iterations"].mean()),
                "most": int(part["iterations"].max()), "most passes": int(part["passes"].max()),
                **milliseconds(part, device), "not converged": int((part["status"] != 0).sum()),
            })  # fmt: skip
    return found


def _phases(situation: Situation, records: NDArray[Any]) -> dict[str, NDArray[Any]]:
    if situation is not IMPACT:
        return {situation.name: records}
    first = int(np.argmax(records["passes"] > 0))
    parts = {"before": records[:first], "at": records[first : first + AT], "after": records[first + AT :]}
    return {f"{situation.name}, {phase}": part for phase, part in parts.items() if len(part)}


def goals_ms(device: str) -> dict[str, dict[int, float | None]]:
    """By situation and number of contacts."""
    return {name: {n: aims[0 if device == "cpu" else 1] for n, aims in by.items()} for name, by in GOALS_MS.items()}


# --- goals ------------------------------------------------------------------------------------------------------------

OBLIQUE = Situation("oblique impact with friction", 40, velocity=(3, -3, 0), height=0.12)
FLAT = Situation("impact without friction", 40, friction=0.0, velocity=(0, -3, 0), height=0.12)
CARRIED = 0.113  # what OBLIQUE moves along x until it hits [m]
GOALS = {  # iterations of a step, at rest in the median, else the most of all, for 10, 100 and 1,000 contacts
    REST.name: {10: 3, 100: 3, 1000: 20}, FLAT.name: {10: 20, 100: 40, 1000: 120},
    OBLIQUE.name: {10: 40, 100: 190, 1000: 200},
}  # fmt: skip
GOALS_MS: dict[str, dict[int, tuple[float | None, float | None]]] = {  # likewise, on a CPU and on a GPU
    REST.name: {10: (1.2, 0.085), 100: (1.4, 0.095), 1000: (6, 0.25)},
    FLAT.name: {10: (4, 0.28), 100: (7, 0.45), 1000: (25, 1.2)},
    OBLIQUE.name: {10: (None, None), 100: (None, None), 1000: (None, None)},
}


def goals(contacts: int, tets: int = 3000, short: bool = False, device: str = "cpu") -> list[Row]:
    """About as many contacts as asked for: on a pillar, on a floor, of eight blocks on a floor."""
    bodies = 8 if contacts == 1000 else 1
    found: list[Row] = []
    for situation in (REST, FLAT, OBLIQUE):
        x = CARRIED if situation is OBLIQUE else 0.0
        under = pillar((x + 0.025, x + 0.065), (0.035, 0.065)) | {"friction": situation.friction}
        obstacle = under if contacts == 10 else None
        driver = begun(situation.simulation(tets, LOCKSTEP, obstacle=obstacle, bodies=bodies, device=device))
        driver.advance(situation.skipped // (6 if short else 1))
        records = several(driver.advance(10 if short else situation.steps), bodies)
        rests = situation is REST
        pick = np.median if rests else np.max
        ms = times(records, device)
        iterations, taken = float(pick(records["iterations"])), float(pick(ms))
        aim, aim_ms = GOALS[situation.name][contacts], goals_ms(device)[situation.name][contacts]
        found.append({
            "device": device, "situation": situation.name, "bodies": bodies, "contacts": int(records["contacts"].max()),
            "of a step": "median" if rests else "most", "iterations": iterations, "goal": aim,
            "reached": _yes(iterations <= aim), "ms": taken, "goal ms": aim_ms,
            "ms reached": "–" if aim_ms is None else _yes(taken <= aim_ms), **of_times(ms),
        })  # fmt: skip
    return found


def _yes(reached: bool) -> str:
    return "yes" if reached else "no"


# --- the effect itself ------------------------------------------------------------------------------------------------

SPACING = 0.01  # of the nodes of 3,000 tetrahedra [m]
ROUNDS = 5
COUNTS = {1: (1, 1), 10: (2, 5), 100: (10, 10)}  # nodes along x and z over the pillar


def own_cost(steps: int = 30, tets: int = 3000, device: str = "cpu") -> list[Row]:
    """A block held at its top hangs at rest: without the effect, with it, with contacts and with obstacles."""
    d = thickness(tets)
    far: Row = {"name": "floor", "shape": "plane", "pose": {"translate": [0, -5, 0]}}
    balls = [
        {"name": f"ball{k}", "shape": "sphere", "radius": 0.01, "pose": {"translate": [0.5 + 0.1 * k, 0, 0.5]}}
        for k in range(100)
    ]
    cases: dict[str, list[Row]] = {"without the effect": [], "listed, an obstacle far away": [far]}
    cases |= {f"{n} obstacles far away": balls[:n] for n in (10, 100)}
    for n, (i, j) in COUNTS.items():
        x, z = (SPACING * (1 - 0.4), SPACING * (i + 0.4)), (SPACING * (1 - 0.4), SPACING * (j + 0.4))
        cases[f"{n} contacts"] = [pillar(x, z, top=-0.6 * d)]
    cases["100 contacts, 100 obstacles"] = [*cases["100 contacts"], *balls[:99]]
    drivers = {}
    for name, obstacles in cases.items():
        held = block(0.5, (10, 5, 10), SIZE, at=(0, 0, 0), fixed=f"Y > {SIZE[1] - 1e-4}", damping=(5.0, 0.0))
        if obstacles:
            sim = over(*obstacles, objects=[held], dt=DT, contact={}, solver=LOCKSTEP, device=device)
        else:
            sim = _without_the_effect(held, device)
        drivers[name] = Driver(sim)
        drivers[name].advance(60)
    rounds = [{name: driver.advance(steps) for name, driver in drivers.items()} for _ in range(ROUNDS)]
    found = [{"device": device, **_of_rounds(name, [each[name] for each in rounds], device)} for name in cases]
    without = found[0]["p50 ms"]
    return [
        row | {"over without": row["p50 ms"] / without, "more than without, ms": row["p50 ms"] - without}
        for row in found
    ]


def _of_rounds(name: str, rounds: list[NDArray[Any]], device: str) -> Row:
    """Least of the medians of the rounds."""
    records = np.concatenate(rounds)
    return {
        "case": name, "contacts": int(records["contacts"][-1]), "iterations": float(records["iterations"].mean()),
        "passes": float(records["passes"].mean()), "p50 ms": min(float(np.median(times(r, device))) for r in rounds),
        "assemble ms": min(float(np.median(1e3 * r["assemble"])) for r in rounds),
    }  # fmt: skip


def _without_the_effect(held: Row, device: str) -> Any:
    table = {key: value for key, value in held.items() if key != "friction"}
    return Simulation(scene(table, dt=DT, gravity=(0, -9.81, 0), **LOCKSTEP), device)
