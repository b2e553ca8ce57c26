# SPDX-License-Identifier: MIT
"""Scenes of bars whose ends are held."""

from typing import Any

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.scenes import bar

TIGHT = {"tolerance": 1e-11, "preconditioner": "block_jacobi", "max_iterations": 5000}
ENDS = {"left": "X < 0.01", "right": "X > 1.99"}


def held_bar(*holders: dict[str, Any], **table: Any) -> Simulation:
    """A bar of 2 m along x. holders: tables without object. device, gravity, integrator, solver; else of `bar`."""
    device, gravity = table.pop("device", "cpu"), table.pop("gravity", None)
    integrator, solver, dt = table.pop("integrator", {}), {**TIGHT, **table.pop("solver", {})}, table.pop("dt", 0.01)
    listed = [{"object": "bar", **h} for h in holders]
    given = {"name": "held", "dt": dt, "object": [bar(**table)], "integrator": integrator, "solver": solver}
    given |= {"effects": {"gravity": {"g": list(gravity)}} if gravity else {}}
    given |= {"holder": listed} if listed else {}
    return Simulation(Scene.model_validate(given, context={"folder": "."}), device)


def left(**keys: Any) -> dict[str, Any]:
    """A holder of the bar's left end."""
    return {"name": "left", "where": ENDS["left"], **keys}


def right(**keys: Any) -> dict[str, Any]:
    """A holder of the bar's right end."""
    return {"name": "right", "where": ENDS["right"], **keys}
