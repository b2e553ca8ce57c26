# SPDX-License-Identifier: MIT
"""Simulations within a program of one's own, without a network: what `import warpfactor` offers of the server."""

import scipy  # noqa: F401  where it is needed it is imported later: a client alone is told of it here

from sim_server.embedded.scene import Mesh, Scene
from sim_server.embedded.simulation import Simulation

__all__ = ["Mesh", "Scene", "Simulation"]
