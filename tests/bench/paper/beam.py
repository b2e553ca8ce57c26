# SPDX-License-Identifier: MIT
"""The beams of the paper's tables: 4 x 1 x 1 m along z, held at z = 0, stiff enough for a given condition number."""

from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np
from scipy.sparse.linalg import eigsh

from sim_server.effects import known_effects
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation

CELLS = {540: (3, 3, 10), 3000: (5, 5, 20), 7350: (7, 7, 25), 24000: (10, 10, 40)}  # along x, y, z
QUICK = (2, 2, 6)
LENGTH, DT, DENSITY, POISSON, DAMPING = 4.0, 0.03, 1000.0, 0.45, 0.1  # m, s, kg/m3, -, 1/s of the mass
FOREVER = 1e9  # s
BANDS = (("Z < 1.4", 1000.0), ("Z < 2.6", 50.0), (None, 10.0))  # of 7, 6 and 7 layers of elements at 3000


@dataclass(frozen=True)
class Load:
    """gravity [m/s2]; twist: of the free end about the axis, by dead loads on its four edges, each [N].

    Both on a beam of 1 MPa; homogeneous ones are loaded in proportion to their stiffness, so that they deform alike.
    """

    name: str
    gravity: tuple[float, float, float]
    twist: float = 0.0
    what: str = ""


# The paper shows its three as pictures: material, geometrical and both non-linearities.
LOADS = (
    Load("stretch", (0, 0, 98.1), what="ten times its weight along the axis: strain, no rotation"),
    Load("bend", (0, -4.905, 0), what="half its weight across: rotation, little strain"),
    Load("bend and twist", (0, -9.81, 0), 5e3, what="its weight across and four loads of 5 kN on the edges of the free "
         "end that turn it about the axis: both, in space"),
)  # fmt: skip


@dataclass(frozen=True)
class Model:
    """A deformation model: its effect, which parameter sets the stiffness, what else it is given."""

    name: str
    paper: str  # its row in table 2
    effect: str
    stiffness: str = "young"
    usual: float = 1e6  # where the search for the stiffness begins
    others: dict[str, Any] = field(default_factory=dict, hash=False)

    def table(self, stiffness: float, heterogeneous: bool = False) -> dict[str, Any]:
        """Parameters of the effect. heterogeneous: in bands, `stiffness` at the held end."""
        value: Any = stiffness
        if heterogeneous:
            most = BANDS[0][1]
            value = [
                {"young": stiffness * share / most} | ({"where": where} if where else {}) for where, share in BANDS
            ]
        return {self.stiffness: value, **self.others}


COROTATIONAL = Model("corotational", "corotational", "corotational", others={"poisson": POISSON})
MODELS = tuple(
    model
    for model in (
        COROTATIONAL,
        Model("St Venant-Kirchhoff", "MJED", "st_venant_kirchhoff", others={"poisson": POISSON}),
        Model("neo-Hookean", "MJED", "neo_hookean", others={"poisson": POISSON}),
        Model("springs", "springs", "mass_spring"),
    )
    if model.effect in known_effects()
)


@dataclass(frozen=True)
class Beam:
    """One of the beams: what it is made of and how stiff."""

    cells: tuple[int, int, int]
    model: Model
    stiffness: float
    heterogeneous: bool = False

    @property
    def share(self) -> float:
        """Of the loads."""
        return 1.0 if self.heterogeneous else self.stiffness / 1e6

    def scene(self, load: Load, **solver: Any) -> Scene:
        """Checked. solver: the [solver] table."""
        share = self.share
        gravity = [share * g for g in load.gravity]
        effects = {
            self.model.effect: self.model.table(self.stiffness, self.heterogeneous),
            "rayleigh": {"mass": DAMPING},
            "fixed": {"where": "Z < 0.01"},
        }
        if load.twist:
            effects["touch"] = {"max_force": 1.1 * share * load.twist, "max_total_force": 5 * share * load.twist}
        beam = {
            "name": "beam",
            "mesh": {"bar": list(self.cells), "size": [1, 1, LENGTH], "split": "kuhn"},
            "elements": "linear",
            "density": DENSITY,
            "effects": effects,
        }
        table = {"name": "paper", "dt": DT, "effects": {"gravity": {"g": gravity}}, "object": [beam]}
        return Scene.model_validate(table | {"solver": solver}, context={"folder": "."})

    def simulation(self, load: Load, device: str = "cpu", **solver: Any) -> Simulation:
        """Of the scene, the load in place."""
        sim = Simulation(self.scene(load, **solver), device)
        if load.twist:
            _twist(sim, self.share * load.twist)
        return sim

    def condition(self) -> float:
        """Largest by smallest eigenvalue of A at rest, held nodes left out (Lanczos)."""
        sim = self.simulation(LOADS[1], preconditioner="none", update="never")
        sim.engine.assemble()
        kept = np.flatnonzero(np.repeat(sim.world.free, 3) > 0)
        matrix = sim.matrix()[kept][:, kept]
        start = np.random.default_rng(0).normal(size=len(kept))
        high = eigsh(matrix, 1, which="LA", v0=start, tol=1e-4, return_eigenvectors=False)
        low = eigsh(matrix, 1, sigma=0, which="LM", v0=start, tol=1e-6, return_eigenvectors=False)
        return float(high[0] / low[0])


def _twist(sim: Simulation, force: float) -> None:
    """Loads on the edges of the free end, along it, around the axis; they keep their direction."""
    touch = sim.touch
    assert touch is not None
    for x, y, along in ((0.5, 0, (1, 0)), (1, 0.5, (0, 1)), (0.5, 1, (-1, 0)), (0, 0.5, (0, -1))):
        touch.push("bench", "beam", (x, y, LENGTH), 0.3, (force * along[0], force * along[1], 0.0), FOREVER)


@cache
def calibrated(
    cells: tuple[int, int, int], model: Model, condition: float, heterogeneous: bool = False
) -> tuple[Beam, float]:
    """The beam with this condition number to three digits, and what it is: by the secant rule on the logarithms."""
    aim, known = np.log(condition), []
    guess = np.log(model.usual)
    for _ in range(20):
        beam = Beam(cells, model, float(np.exp(guess)), heterogeneous)
        found = beam.condition()
        known.append((guess, np.log(found)))
        if abs(found / condition - 1) < 5e-4:
            return beam, found
        if len(known) == 1:
            guess += aim - known[0][1]
            continue
        (x0, y0), (x1, y1) = known[-2:]
        step = (aim - y1) * (x1 - x0) / (y1 - y0) if y1 != y0 else aim - y1
        guess = x1 + float(np.clip(step, -3, 3))
    raise RuntimeError(f"{model.name}: no stiffness gives condition number {condition:g}; last {found:.4g}")
