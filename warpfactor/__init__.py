# SPDX-License-Identifier: MIT
"""Soft bodies in real time, from Python: `import warpfactor as wf`.

wf.Simulation, wf.Scene, wf.Mesh   simulate in this process; they need the extra server
wf.sweep                           one scene at many values: a table
wf.Client                          a server that runs: push, grab, watch, steer
wf.Log                             what a run has recorded
wf.gym                             environments of gymnasium; they need the extra gym

Names are imported when they are first used, so that a client needs no more than a client.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from protocol.process.extras import missing_extra

if TYPE_CHECKING:
    from clients.client import Client
    from clients.log.reader import Log
    from sim_server import gym
    from sim_server.embedded import Mesh, Scene, Simulation
    from sim_server.embedded.sweep import sweep

__all__ = ["Client", "Log", "Mesh", "Scene", "Simulation", "gym", "sweep"]

_PLACES = {
    "Client": "clients.client",
    "Log": "clients.log.reader",
    "Mesh": "sim_server.embedded",
    "Scene": "sim_server.embedded",
    "Simulation": "sim_server.embedded",
    "gym": "sim_server.gym",
    "sweep": "sim_server.embedded.sweep",
}


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'warpfactor' has no attribute {name!r}; there is {', '.join(__all__)}")
    try:
        found = getattr(place := import_module(_PLACES[name]), name, place)
    except ModuleNotFoundError as error:
        if advice := missing_extra(error):
            raise ModuleNotFoundError(f"warpfactor.{name}: {advice}", name=error.name) from error
        raise
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
