# SPDX-License-Identifier: MIT
"""What a hard case is: a scene, what is done to it, and what must hold."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

from sim_server.simulation import Simulation
from tests.hard_cases.sources import Source
from tests.hard_cases.starts import Start, nothing

BAR = Path(__file__).with_name("bar.toml")
FREE_BAR = Path(__file__).with_name("free_bar.toml")
GRAVITY = "effects.gravity.g=[0,-9.81,0]"


def young(*bands: tuple[str, float]) -> str:
    """Override for bands of stiffness: (where, Pa), the last one takes the rest."""
    tables = [f'{{ where = "{where}", young = {value:g} }}' for where, value in bands[:-1]]
    return f"object.bar.effects.corotational.young=[{', '.join([*tables, f'{{ young = {bands[-1][1]:g} }}'])}]"


@dataclass(frozen=True)
class Hold:
    """A push or (with a target) a grab of the free nodes within radius of a point, during steps [0, until)."""

    until: int
    point: tuple[float, float, float]
    radius: float
    force: tuple[float, float, float] = (0, 0, 0)
    target: tuple[float, float, float] | None = None
    stiffness: float = 0
    limit: float = 0


@dataclass(frozen=True)
class Case:
    """One line of the table.

    file, scene: scene file and overrides; build: what makes the simulation from overrides, folder and device, instead.
    done: in words; start, hold and source do it. steps: of the run.
    rests: where it comes back to: "pose" (no load), "static" (its equilibrium, found by a heavily damped run at another
    time step), "still" (wherever it is at the end), "same" (at every step where the same run without any
    preconditioner, solved to 1e-10, is) or "spin" (nowhere: free). within: distance to it, largest over the nodes /
    length of the bar; recovered: step from which it must stay there.
    energy: largest allowed rise of energy - work of loads over its lowest earlier value, as a part of what the run
    dissipates. unconverged: how many steps may end with a status other than converged, by status.
    upright: det F > 0 in every element at the end. refused: the model does not define the state: every solve ends with
    not_finite, an element is named, nothing moves, and put back to rest the body goes on. fails: known not to hold all
    of this; the statuses must tell. iterations: largest allowed mean over the steps with a factor.
    seed: of running.seeded. several: the law has several stable equilibria, and rounding decides to which one it comes.
    easy, easy_start: overrides and start that make it easy, for what the case costs; None: it has no cost of its own.
    note: what must be known to read the line; where something does not hold, why.
    """

    name: str
    done: str
    scene: tuple[str, ...] = ()
    file: Path = BAR
    start: Start = nothing
    hold: Hold | None = None
    source: Source | None = None
    build: Callable[..., Simulation] | None = None
    steps: int = 400
    rests: Literal["pose", "static", "still", "same", "spin"] = "pose"
    within: float = 1e-3
    recovered: int = 0
    energy: float = 1e-9
    unconverged: dict[str, int] = field(default_factory=dict)
    upright: bool = True
    refused: bool = False
    fails: bool = False
    iterations: float = 0
    seed: int = 0
    several: bool = False
    easy: tuple[str, ...] | None = (GRAVITY,)
    easy_start: Start = nothing
    note: str = ""

    def twin(self) -> "Case":
        """The same bar made easy: ordinary material and step, nothing done to it."""
        given = {"scene": self.easy or (), "start": self.easy_start, "hold": None, "source": None, "build": None}
        return replace(self, seed=0, refused=False, **given)

    def must_hold(self) -> str:
        """In words, from the same numbers that are asserted."""
        if self.refused:
            return "refused: every solve not_finite, an element named, nothing moves; put back to rest it goes on"
        energy = f"energy rises by at most {self.energy:g}" if self.energy > 1e-6 else "energy never rises"
        parts = ["finite", energy]
        allowed = [f"{count} × {status}" for status, count in self.unconverged.items()]
        parts.append("converged" + (f" but for at most {', '.join(allowed)}" if allowed else ""))
        to = {
            "pose": "of rest",
            "static": "of its static state",
            "still": "of where it ends",
            "same": "of plain CG solved to 1e-10,",
        }
        if self.rests != "spin":
            since = f" from step {self.recovered} on" if self.rests != "same" else " at every step"
            parts.append(f"within {self.within:g} L {to[self.rests]}{since}")
        if self.upright:
            parts.append("J > 0 at the end")
        if self.iterations:
            parts.append(f"≤ {self.iterations:g} iterations with a factor")
        return "; ".join(parts)
