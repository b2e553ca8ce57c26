# SPDX-License-Identifier: MIT
"""What a grab costs until a factor has it, and what the Woodbury correction saves of that.

A hand takes hold of some nodes at the free end of a beam, draws them sideways and lets go. Springs set in just after a
matrix went out, so that the next two factors (lockstep-D: 2 D - 1 solves) do not know them; likewise when it lets go.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.effects.touch import Interaction, Touch
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.harness.schemes import SCENES

SPEED = 0.5  # m/s, of the hand
SETTLED = 18  # steps before it comes, about
WAYS: dict[str, dict[str, Any]] = {
    "stale": {"woodbury": 0}, "corrected": {"woodbury": 64}, "fresh": {"woodbury": 0, "update": "every-1"},
}  # fmt: skip
TIMED = ("stale", "corrected")
WORDS = """\
*nodes*: grabbed; *stiffness*: of the spring of each, what it adds to A by the mean diagonal of the nodes' own blocks.
Iterations of the first solve and of all until a factor has the springs, or lacks them again. *stale*: the warped factor
alone; *corrected*: `woodbury` (native/woodbury.h); *fresh*: a factor of each step's matrix. *ms*: processor
time of these steps, assembly and all, the least of the rounds for each step."""


@dataclass(frozen=True)
class Hand:
    """nodes: grabbed. stiffness: what the spring of each adds to A, by the mean diagonal of its own block."""

    nodes: int
    stiffness: float


def grab_row(scene: str, cells: tuple[int, int, int], latency: int, hand: Hand, rounds: int) -> dict[str, Any]:
    """Iterations and processor time of every way."""
    found = {
        name: [held_records(scene, cells, latency, hand, way) for _ in range(rounds if name in TIMED else 1)]
        for name, way in WAYS.items()
    }
    out: dict[str, Any] = {
        "scene": scene, "tets": 6 * int(np.prod(cells)), "D": latency, "nodes": hand.nodes, "stiffness": hand.stiffness,
    }  # fmt: skip
    for when, phase in enumerate(("grab", "release")):
        for name in found:
            out[f"{phase}: first, {name}"] = int(found[name][0][when]["iterations"][0])
        for name in found:
            out[f"{phase}: {name}"] = int(found[name][0][when]["iterations"].sum())
        for name in TIMED:
            out[f"{phase}: ms, {name}"] = 1e3 * float(np.min([r[when]["cpu"] for r in found[name]], axis=0).sum())
    records = [r for runs in found.values() for run in runs for r in run]
    out["unconverged"] = sum(int((r["status"] != 0).sum()) for r in records)
    return out


def short(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The same for the eye: what belongs together in one cell, in the order of WAYS."""
    out = []
    for r in rows:
        cells = {key: r[key] for key in ("scene", "tets", "D", "nodes", "stiffness")}
        for phase in ("grab", "release"):
            cells[f"{phase}: first"] = " / ".join(str(r[f"{phase}: first, {name}"]) for name in WAYS)
            cells[f"{phase}: all"] = " / ".join(str(r[f"{phase}: {name}"]) for name in WAYS)
            cells[f"{phase}: ms"] = " → ".join(f"{r[f'{phase}: ms, {name}']:.3g}" for name in TIMED)
        out.append(cells)
    return out


def held_records(
    scene: str, cells: tuple[int, int, int], latency: int, hand: Hand, way: dict[str, Any], device: str = "cpu"
) -> tuple[NDArray[Any], NDArray[Any]]:
    """Records of the solves after the grab, and after its end, that have factors without the change."""
    solver = {
        "preconditioner": "cholesky",
        "update": f"lockstep-{latency}",
        "warp": True,
        "max_iterations": 5000,
        **way,
    }
    overrides = [f"solver.{key}={_toml(value)}" for key, value in solver.items()]
    overrides += [f"object.beam.mesh.bar={list(cells)}", "object.beam.effects.touch={max_force=1e15}"]
    sim = Simulation.load(SCENES / f"{scene}.toml", overrides, device)
    at_rest = Simulation.load(SCENES / f"{scene}.toml", overrides)
    touch, driver, unaware = sim.touch, Driver(sim), 2 * latency - 1
    assert touch is not None
    driver.step_with_fresh_factors()
    driver.advance(max(1, SETTLED // latency) * latency + 1)  # a matrix has gone out with the last one
    held = _grab(sim, touch, hand, at_rest)
    grabbed = []
    for _ in range(4 * latency):
        grabbed.append(driver.advance(1))
        x, y, z = held.target
        held = touch.move("bench", held.id, (x, y + SPEED * sim.world.dt, z))
    touch.release("bench", held.id)
    return np.concatenate(grabbed)[:unaware], driver.advance(unaware)


def _toml(value: Any) -> str:
    return f"'{value}'" if isinstance(value, str) else str(value).lower()


def _grab(sim: Simulation, touch: Touch, hand: Hand, at_rest: Simulation) -> Interaction:
    """So many nodes nearest to the middle of the free end's upper edge. at_rest: the same on a CPU, for its blocks."""
    sim.fetch()
    at_rest.engine.assemble()
    w, s = sim.world, at_rest.system
    corner = w.rest.max(axis=0) * [0.5, 1.0, 1.0]
    point = w.x[np.linalg.norm(w.rest - corner, axis=1).argmin()] + [1e-3, 2e-3, 3e-3]  # no two at one distance
    distance = np.where(w.free > 0, np.linalg.norm(w.x - point, axis=1), np.inf)
    order = np.argsort(distance)
    near, radius = order[: hand.nodes], float(distance[order[hand.nodes - 1 : hand.nodes + 1]].mean())
    own = float((s.diagonal + s.block[:, [0, 3, 5]].sum(axis=1) / 3)[near].mean())
    stiffness = hand.nodes * hand.stiffness * own / (w.force_coefficient * w.dx_dv)
    at = (float(point[0]), float(point[1]), float(point[2]))
    held = touch.grab("bench", "beam", at, radius, at, stiffness, 0.0, 1e9)
    assert len(held.nodes) == hand.nodes
    return held
