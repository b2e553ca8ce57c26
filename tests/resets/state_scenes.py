# SPDX-License-Identifier: MIT
"""Small scenes, each with another kind of state that a step leaves to the next."""

from typing import Any

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.scenes import bar

CUBE: dict[str, Any] = {"cells": (2, 2, 2), "size": (0.2, 0.2, 0.2), "touch": True}
FLOOR: dict[str, Any] = {"name": "floor", "shape": "plane", "friction": 0.5}
SLOPE: dict[str, Any] = FLOOR | {"pose": {"rotate": [0, 0, -20]}}
TOOL: dict[str, Any] = {
    "name": "tool", "shape": "sphere", "radius": 0.05, "moved": "client", "max_speed": 1.0,
    "pose": {"translate": [0.1, 0.4, 0.1]},
}  # fmt: skip
WEAK: dict[str, Any] = {"name": "weak", "object": "right", "to": "left", "where": "X < 0.01", "breaking": 2.0}
NEWTON = {"scheme": "backward_euler", "linearizations": 3}


def cube(name: str = "cube", x: float = 0.0, y: float = 0.001, **keys: Any) -> dict[str, Any]:
    """A cube of 8 kg that rests a millimetre above y = 0."""
    return bar(**CUBE, name=name, pose={"translate": [x, y, 0]}, friction=0.5, **keys)


def beam(**keys: Any) -> dict[str, Any]:
    return bar(
        cells=(4, 1, 1), size=(0.4, 0.1, 0.1), fixed="X < 0.01", touch=True, young=3e5, **{"name": "beam"} | keys
    )


def remembering(body: dict[str, Any], effects: dict[str, Any]) -> dict[str, Any]:
    """The same body with effects that have a memory."""
    return body | {"effects": body["effects"] | effects}


def halves() -> list[dict[str, Any]]:
    """Two bars end to end, the right one to be tied to the left one."""
    left = bar(cells=(2, 1, 1), size=(0.2, 0.1, 0.1), name="left", fixed="X < 0.01", young=3e5)
    right = bar(cells=(2, 1, 1), size=(0.2, 0.1, 0.1), name="right", pose={"translate": [0.2, 0, 0]}, young=3e5)
    return [left, right]


def table(objects: list[dict[str, Any]], **keys: Any) -> dict[str, Any]:
    """A scene file as a table."""
    effects = {"gravity": {"g": [0, -9.81, 0]}} | keys.pop("effects", {})
    effects |= {"contact": True} if "obstacle" in keys and "contact" not in effects else {}
    solver = {"preconditioner": "cholesky", "update": "every-3", "max_iterations": 2000} | keys.pop("solver", {})
    return {"name": "state", "dt": 0.01, "object": objects, "effects": effects, "solver": solver, **keys}


LAWS = {
    "neo_hookean": {"young": 3e5, "poisson": 0.4}, "mass_spring": {"young": 1e5}, "fixed": {"where": "X < 0.01"},
    "touch": True,
}  # fmt: skip
VISCOUS = {"prony": {"terms": [{"g": 0.8, "tau": 0.05}, {"g": 0.3, "tau": 1.0}], "shear": 1e5}}
FLOWING = {"plasticity": {"yield_stress": 300.0, "hardening": 1e3}}
POROUS = {"poroelasticity": {"mobility": 1e-6, "storage": 1e6, "drained": "X > 0.39"}}
TEARING = {"damage": {"strength": 500.0, "fracture_energy": 1.0}}
MIXED = bar(cells=(2, 2, 2), size=(0.2, 0.2, 0.2), name="cube", density=1000, young=None) | {"effects": LAWS}
LOADS = {
    "muscle": {"stress": 5e4, "direction": [1, 0, 0]}, "traction": {"where": "X > 0.39", "pressure": 100.0},
    "target": {"to": ["X", "Y", "1.1 * Z"], "stiffness": 100.0},
    "wind": {"velocity": [3, 0, 5]}, "buoyancy": {"level": 0.05},
    "cable": [
        {"path": [[0, 0, 0], [0.4, 0, 0]], "tension": 5.0}, {"path": [[0, 0.1, 0], [0.4, 0.1, 0]], "stiffness": 1e3},
    ],
}  # fmt: skip
SCENES: dict[str, dict[str, Any]] = {
    "laws": table([beam(tangent="exact"), MIXED]),
    "newton": table([beam()], integrator=NEWTON),
    "newmark": table([beam()], integrator={"scheme": "newmark"}),
    "bdf2": table([beam()], integrator={"scheme": "bdf2"}),
    "generalized_alpha": table([beam()], integrator={"scheme": "generalized_alpha", "linearizations": 2}),
    "ros2": table([beam()], integrator={"scheme": "ros2"}),
    "central_difference": table(
        [beam()], integrator={"scheme": "central_difference"}, solver={"preconditioner": "none"}
    ),
    "friction": table([cube(), cube("next", x=0.21)], obstacle=[SLOPE, TOOL]),
    "friction, bdf2": table([cube()], obstacle=[SLOPE, TOOL], integrator={"scheme": "bdf2"}),
    "attached": table(halves(), attachment=[WEAK]),
    "prony": table(
        [remembering(beam(), VISCOUS), beam(name="other", pose={"translate": [0, 0, 1]})], integrator=NEWTON
    ),
    "prony, friction, bdf2": table(
        [remembering(cube(), VISCOUS), remembering(cube("next", x=0.15, y=0.21), VISCOUS)],
        obstacle=[SLOPE, TOOL],
        integrator={"scheme": "bdf2"},
    ),
    "plasticity": table([remembering(beam(), FLOWING), beam(name="other", pose={"translate": [0, 0, 1]})]),
    "damage": table(
        [remembering(beam(), TEARING), beam(name="other", pose={"translate": [0, 0, 1]})], integrator=NEWTON
    ),
    "poroelasticity": table([remembering(beam(), POROUS), beam(name="other", pose={"translate": [0, 0, 1]})]),
    "loaded": table([beam() | {"effects": beam()["effects"] | LOADS}]),
    "held": table(
        [beam()], holder=[{"name": "hand", "object": "beam", "where": "X > 0.39", "moved": "client", "max_speed": 0.5}]
    ),
}


def made(name: str, device: str = "cpu", **solver: Any) -> Simulation:
    """One of SCENES. solver: other values of its table."""
    found = SCENES[name] | {"solver": SCENES[name]["solver"] | solver}
    return Simulation(Scene.model_validate(found, context={"folder": "."}), device)
