# SPDX-License-Identifier: MIT
"""The link of a simulation with workers, without the rest of a server."""

from protocol.channels import SERVER_NAME
from sim_server.network.link import ServerLink
from sim_server.recording import messages
from sim_server.simulation import Simulation


def link_of(sim: Simulation, endpoint: str, name: str = SERVER_NAME, shared_memory: bool = True) -> ServerLink:
    """Listens at an endpoint and offers the scene and all objects."""
    link = ServerLink(name, [endpoint], shared_memory=shared_memory)
    link.set_scene(messages.scene(sim))
    for body in sim.world.bodies:
        link.announce(messages.topology(sim, body))
    return link
