# SPDX-License-Identifier: MIT
"""What `[solver] on_runaway = "halve"` does not go together with."""

from collections.abc import Mapping
from typing import Any

from sim_server.scene.integrator_options import IntegratorOptions
from sim_server.scene.parameters import complaint
from sim_server.scene.solver_options import SolverOptions

SCHEMES = {
    "quasi_static": "has no time step to halve",
    "ros2": "goes back to backward Euler by its own estimate",
    "central_difference": "makes the step again by shorter substeps anyway",
}


def check_halving(solver: SolverOptions, integrator: IntegratorOptions, listed: Mapping[str, Any]) -> None:
    """Raises a complaint. listed: parts of the scene that may be there, by key."""
    if solver.on_runaway != "halve":
        return
    given, others = 'solver.on_runaway = "halve"', 'allowed: "freeze", "go_on"'
    if why := SCHEMES.get(integrator.scheme):
        raise complaint(f'{given} with integrator.scheme = "{integrator.scheme}", which {why}; {others}')
    for name, part in listed.items():
        if part:
            raise complaint(f"{given} with {name}, whose step is that of all objects together; {others}")
    for name in ("budget", "budget_ms"):
        if value := getattr(solver, name):
            raise complaint(f"{given} with solver.{name} = {value:g}: short steps take as many times longer; {others}")
