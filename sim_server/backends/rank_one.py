# SPDX-License-Identifier: MIT
"""Parts of A of rank one, which a solve applies beside its blocks: scale u u^T over many nodes (effects/cavity.py)."""

from dataclasses import dataclass

from sim_server.arrays import Float64, Int32


@dataclass(frozen=True)
class RankOne:
    """Parts of A of rank one, of one body each.

    first: (bodies + 1,) the first one of each body
    start: (parts + 1,) into the nodes
    node: (k,) of the scene
    free: (nodes of the scene,) 0 at fixed nodes, whose rows of A are the identity: u is 0 there
    slope: (k, 3) u there, world frame; launches make it
    scale: (parts, 4) at 2: factor of u u^T [kg over the square of u], at least 0; launches make it
    """

    first: Int32
    start: Int32
    node: Int32
    slope: Float64
    scale: Float64
    free: Float64
