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
    pillar,
    several,
    solvers,
    thickness,
)
from tests.contact.scenes import block, over

AT = 6  # steps from the first contact on that are the impact


def begun(sim: Simulation) -> Driver:
    """With factors from the first step on."""
    driver = Driver(sim)
    if driver.wants_factors:
        driver.step_with_fresh_factors()
    else:
        driver.advance(1)
    return driver


def rows(tets: int, kappa: float, situation: Situation, short: bool = False) -> list[Row]:
    """A row of each preconditioner; of an impact three: before, at and after it."""
    found: list[Row] = []
    for name, solver in solvers(tets).items():
        driver = begun(situation.simulation(tets, solver, kappa))
        driver.advance(situation.skipped // (6 if short else 1))
        records = driver.advance(10 if short else situation.steps)
        for phase, part in _phases(situation, records).items():
            found.append({
                "tets": tets, "kappa": kappa, "situation": phase, "preconditioner": name, "steps": len(part),
                "contacts": int(part["contacts"].max()), "iterations": float(part["iterations"].mean()),
                "most": int(part["iterations"].max()), "most passes": int(part["passes"].max()),
                **milliseconds(part), "not converged": int((part["status"] != 0).sum()),
            })  # fmt: skip
    return found


def _phases(situation: Situation, records: NDArray[Any]) -> dict[str, NDArray[Any]]:
    if situation is not IMPACT:
        return {situation.name: records}
    first = int(np.argmax(records["passes"] > 0))
    parts = {"before": records[:first], "at": records[first : first + AT], "after": records[first + AT :]}
    return {f"{situation.name}, {phase}": part for phase, part in parts.items() if len(part)}


def impact_curves(tets: int) -> list[Row]:
    """Iterations and time of each step of the impact."""
    found = []
    for name, solver in solvers(tets).items():
        records = begun(IMPACT.simulation(tets, solver)).advance(30)
        found.append({
            "tets": tets, "preconditioner": name, "step": records["step"].tolist(),
            "iterations": records["iterations"].tolist(), "ms": (1e3 * records["cpu"]).tolist(),
        })  # fmt: skip
    return found


# --- goals ------------------------------------------------------------------------------------------------------------

OBLIQUE = Situation("oblique impact with friction", 40, velocity=(3, -3, 0), height=0.12)
FLAT = Situation("impact without friction", 40, friction=0.0, velocity=(0, -3, 0), height=0.12)
CARRIED = 0.113  # what OBLIQUE moves along x until it hits [m]
GOALS: dict[str, dict[int, tuple[float, float | None]]] = {  # iterations of a step (at rest in the median, else the
    # most of all) and milliseconds, for 10, 100 and 1,000 contacts
    REST.name: {10: (3, 1.2), 100: (3, 1.4), 1000: (20, 6)},
    FLAT.name: {10: (20, 4), 100: (40, 7), 1000: (120, 25)},
    OBLIQUE.name: {10: (40, None), 100: (190, None), 1000: (200, None)},
}


def goals(contacts: int, tets: int = 3000, short: bool = False) -> list[Row]:
    """About as many contacts as asked for: on a pillar, on a floor, of eight blocks on a floor."""
    bodies = 8 if contacts == 1000 else 1
    found: list[Row] = []
    for situation in (REST, FLAT, OBLIQUE):
        x = CARRIED if situation is OBLIQUE else 0.0
        under = pillar((x + 0.025, x + 0.065), (0.035, 0.065)) | {"friction": situation.friction}
        driver = begun(situation.simulation(tets, LOCKSTEP, obstacle=under if contacts == 10 else None, bodies=bodies))
        driver.advance(situation.skipped // (6 if short else 1))
        records = several(driver.advance(10 if short else situation.steps), bodies)
        rests = situation is REST
        pick = np.median if rests else np.max
        iterations, ms = float(pick(records["iterations"])), float(pick(1e3 * records["cpu"]))
        aim, aim_ms = GOALS[situation.name][contacts]
        found.append({
            "situation": situation.name, "bodies": bodies, "contacts": int(records["contacts"].max()),
            "of a step": "median" if rests else "most", "iterations": iterations, "goal": aim,
            "reached": _yes(iterations <= aim), "ms": ms, "goal ms": aim_ms,
            "ms reached": "–" if aim_ms is None else _yes(ms <= aim_ms),
            "median ms": float(np.median(1e3 * records["cpu"])),
        })  # fmt: skip
    return found


def _yes(reached: bool) -> str:
    return "yes" if reached else "no"


# --- the effect itself ------------------------------------------------------------------------------------------------

SPACING = 0.01  # of the nodes of 3,000 tetrahedra [m]
ROUNDS = 5
COUNTS = {1: (1, 1), 10: (2, 5), 100: (10, 10)}  # nodes along x and z over the pillar


def own_cost(steps: int = 30, tets: int = 3000) -> list[Row]:
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
            sim = over(*obstacles, objects=[held], dt=DT, contact={}, solver=LOCKSTEP)
        else:
            sim = _without_the_effect(held)
        drivers[name] = Driver(sim)
        drivers[name].advance(60)
    rounds = [{name: driver.advance(steps) for name, driver in drivers.items()} for _ in range(ROUNDS)]
    found = [_of_rounds(name, [each[name] for each in rounds]) for name in cases]
    return [row | {"more than without, ms": row["p50 ms"] - found[0]["p50 ms"]} for row in found]


def _of_rounds(name: str, rounds: list[NDArray[Any]]) -> Row:
    """Least of the medians of the rounds."""
    records = np.concatenate(rounds)
    return {
        "case": name, "contacts": int(records["contacts"][-1]), "iterations": float(records["iterations"].mean()),
        "passes": float(records["passes"].mean()), "p50 ms": min(float(np.median(1e3 * r["cpu"])) for r in rounds),
        "assemble ms": min(float(np.median(1e3 * r["assemble"])) for r in rounds),
    }  # fmt: skip


def _without_the_effect(held: Row) -> Any:
    from tests.scenes import simulation

    table = {key: value for key, value in held.items() if key != "friction"}
    return simulation(table, dt=DT, gravity=(0, -9.81, 0), **LOCKSTEP)
