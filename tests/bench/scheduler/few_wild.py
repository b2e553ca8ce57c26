# SPDX-License-Identifier: MIT
"""The load of the scheduler's benchmark: a few objects are dragged about by hands, the rest hardly move."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sim_server.effects.touch import Interaction, Touch
from sim_server.mechanics.world import Body
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation

SIZES = ((4, 2, 2), (6, 3, 2), (6, 3, 3))  # cells: 96, 216, 324 tetrahedra
LENGTH, DT = 3.0, 0.02  # m, s
YOUNG = 1e5  # Pa, of the third at the wall; the rest of an uneven object is a hundred times as stiff
STIFFNESS, RADIUS, REACH = 1e7, 0.8, 1.0  # of a hand [N/m], [m]; how far it drags [m], standard deviation per axis
APART = 16  # one object in so many is wild, one at least


def scene(objects: int, **solver: Any) -> Scene:
    """Beams of mixed sizes, every second one uneven, each held at one end."""
    table = {"name": "few wild", "dt": DT, "object": [_object(k) for k in range(objects)],
             "solver": {"preconditioner": "cholesky", "warp": True, **solver}}  # fmt: skip
    return Scene.model_validate(table, context={"folder": "."})


def is_wild(index: int) -> bool:
    return index % APART == 0


def _object(index: int) -> dict[str, Any]:
    young: Any = YOUNG
    if (index // APART if is_wild(index) else index) % 2:
        young = [{"where": f"X < {LENGTH / 3}", "young": YOUNG}, {"where": f"X >= {LENGTH / 3}", "young": 100 * YOUNG}]
    effects = {"corotational": {"young": young, "poisson": 0.3}, "rayleigh": {"mass": 0.5, "stiffness": 0.01},
               "fixed": {"where": "X < 0.01"}}  # fmt: skip
    if is_wild(index):
        effects["touch"] = {"max_force": 1e9, "max_total_force": 1e9}
    cells = SIZES[index % len(SIZES)]
    return {
        "name": f"beam{index}",
        "mesh": {"bar": list(cells), "size": [LENGTH, 1, 1], "split": "kuhn"},
        "elements": "linear",
        "effects": effects,
    }


@dataclass
class Hand:
    """Takes hold of an object somewhere, drags it to another place, lets go, takes hold elsewhere, forever."""

    body: Body
    rng: np.random.Generator
    hold: int  # steps of one grab
    age: int  # steps of the present one
    held: Interaction | None = None

    def act(self, touch: Touch, x: np.ndarray) -> None:
        """Before each step. x: positions of all nodes."""
        if self.held is None or self.age >= self.hold:
            self._elsewhere(touch, x)
        assert self.held is not None
        way = min(1.0, self.age / (0.7 * self.hold))
        touch.move("hand", self.held.id, tuple(self.start + way * (self.goal - self.start)))
        self.age += 1

    def _elsewhere(self, touch: Touch, x: np.ndarray) -> None:
        if self.held is not None:
            touch.release("hand", self.held.id)
            self.age = 0
        rest = self.body.mesh.rest
        node = self.rng.choice(np.flatnonzero(rest[:, 0] > LENGTH / 3))
        self.start = x[self.body.nodes][node].copy()
        self.goal = rest[node] + REACH * self.rng.normal(size=3)
        self.held = touch.grab(
            "hand", self.body.name, tuple(self.start), RADIUS, tuple(self.start), STIFFNESS, 0.0, 1e9
        )


class Load:
    """What happens to the objects of a simulation of `scene`, drawn from a seed."""

    def __init__(self, simulation: Simulation, hold: int, seed: int):
        self._x = simulation.world.x
        touch = simulation.effects["touch"]
        assert isinstance(touch, Touch)
        self._touch, rng = touch, np.random.default_rng(seed)
        self._hands = []
        for body in simulation.world.bodies:
            if is_wild(body.index):
                own = np.random.default_rng([seed, body.index])
                self._hands.append(Hand(body, own, hold, int(own.integers(hold))))
            else:  # trembles
                bend = (body.mesh.rest[:, :1] / LENGTH) ** 2
                simulation.world.v[body.nodes] = 1e-5 * bend * rng.normal(size=3)

    def act(self) -> None:
        """Before each step."""
        for hand in self._hands:
            hand.act(self._touch, self._x)
