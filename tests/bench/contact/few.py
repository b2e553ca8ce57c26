# SPDX-License-Identifier: MIT
"""A few contacts of a tool, or nodes in a hand: what the correction of the factor for them saves (native/woodbury.h;
on a GPU correction_state.cuh)."""

from dataclasses import dataclass
from typing import Any

from sim_server.simulation import Simulation
from tests.bench.contact.bodies import DT, JACOBI, LOCKSTEP, Row, milliseconds, times
from tests.bench.contact.cost import begun
from tests.bench.preconditioners.grabs import Hand, held_records
from tests.contact.scenes import block, over

STEPS = 100
ALONG = (90.0, 0.0, 0.0)  # degrees: the tool's axis lies along z


@dataclass(frozen=True)
class Tooled:
    """A body, held at a face, and a round tool that presses into it, strokes it and leaves.

    path: (time [s], x, y, z [m]) of the tool
    """

    name: str
    cells: tuple[int, int, int]
    size: tuple[float, float, float]
    fixed: str
    young: float
    path: tuple[tuple[float, float, float, float], ...]

    def simulation(self, solver: dict[str, Any], kappa: float, device: str) -> Simulation:
        """With gravity, Poisson's ratio 0.45 and friction 0.3."""
        frames = [{"time": t, "rotate": list(ALONG), "translate": [x, y, z]} for t, x, y, z in self.path]
        tool: Row = {"name": "tool", "shape": "capsule", "radius": 0.01, "length": 0.06, "friction": 0.3}
        body = block(0.3, self.cells, self.size, at=(0, 0, 0), fixed=self.fixed, young=self.young, poisson=0.45,
                     damping=(1.0, 0.0))  # fmt: skip
        tool["keyframes"] = frames
        return over(tool, objects=[body], dt=DT, contact={"stiffness": kappa}, solver=solver,
                    device=device)  # fmt: skip


def _beam(cells: tuple[int, int, int]) -> Tooled:
    path = ((0.0, 0.35, -0.02, 0.015), (0.5, 0.35, 0.01, 0.015), (1.2, 0.45, 0.01, 0.015), (1.6, 0.45, -0.03, 0.015))
    return Tooled("slender beam, held at an end", cells, (0.5, 0.04, 0.03), "X < 0.001", 1e6, path)


def _slab(cells: tuple[int, int, int]) -> Tooled:
    path = ((0.0, 0.08, 0.09, 0.1), (0.4, 0.08, 0.06, 0.1), (1.2, 0.14, 0.06, 0.1), (1.6, 0.14, 0.1, 0.1))
    return Tooled("flat slab, held at its base", cells, (0.2, 0.06, 0.2), "Y < 0.001", 1e5, path)


BODIES = {"beam": _beam((50, 4, 3)), "slab": _slab((10, 5, 10)), "large slab": _slab((20, 10, 20))}
SMALL = _beam((10, 2, 2))
HELD = (5, 5, 20)  # cells of the beam in a hand
HANDS = (Hand(1, 100.0), Hand(4, 1.0), Hand(16, 1.0), Hand(16, 100.0), Hand(32, 100.0))
CORRECTED, UNCORRECTED = "factor, corrected", "factor, not corrected"


def rows(tooled: Tooled, kappa: float, age: int, steps: int = STEPS, device: str = "cpu") -> list[Row]:
    """Steps in which the tool touches. age: of a factor when it comes [steps]."""
    factor = LOCKSTEP | {"update": f"lockstep-{age}"}
    solvers = {
        CORRECTED: factor, UNCORRECTED: factor | {"woodbury": 0},
        JACOBI: {"preconditioner": "block_jacobi", "max_iterations": 5000},
    }  # fmt: skip
    found = []
    for name, solver in solvers.items():
        records = begun(tooled.simulation(solver, kappa, device)).advance(5 + steps)[5:]
        touching = records[records["passes"] > 0]
        found.append({
            "device": device, "body": tooled.name,
            "nodes": (tooled.cells[0] + 1) * (tooled.cells[1] + 1) * (tooled.cells[2] + 1),
            "kappa": kappa, "lockstep": age, "preconditioner": name, "contacts": int(touching["contacts"].max()),
            "passes": float(touching["passes"].mean()), "iterations": float(touching["iterations"].mean()),
            "most": int(touching["iterations"].max()), "mean ms": float(times(touching, device).mean()),
            **milliseconds(touching, device),
        })  # fmt: skip
    return found


def hand_rows(hand: Hand, age: int, cells: tuple[int, int, int] = HELD, device: str = "cpu") -> list[Row]:
    """Steps in which the factor does not know that a hand has taken hold of a beam, or has let go of it."""
    found = []
    for name, way in {CORRECTED: {"woodbury": 32}, UNCORRECTED: {"woodbury": 0}}.items():
        phases = zip(("takes hold", "lets go"), held_records("beam", cells, age, hand, way, device), strict=True)
        for phase, records in phases:
            found.append({
                "device": device, "body": f"beam, a hand {phase} ({hand.stiffness:g} blocks)",
                "nodes": (cells[0] + 1) * (cells[1] + 1) * (cells[2] + 1), "kappa": 0.0, "lockstep": age,
                "preconditioner": name, "contacts": hand.nodes, "passes": 0.0,
                "iterations": float(records["iterations"].mean()), "most": int(records["iterations"].max()),
                "mean ms": float(times(records, device).mean()), **milliseconds(records, device),
            })  # fmt: skip
    return found
