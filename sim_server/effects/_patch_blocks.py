# SPDX-License-Identifier: MIT
"""What patches of elements add to the matrix, one of rank one each."""

from sim_server.arrays import Float64
from sim_server.backends.base import Launch
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import World


def patch_blocks(world: World, system: System, places: Stencil, patch_gradients: Float64) -> tuple[Launch, Launch]:
    """Returns the launches that add to the nodes' own blocks, and to those above the diagonal, once these are written.

    places: of the patches; patch_gradients: (corners, 4), as of kernels/patch_blocks.cu
    """
    text = world.backend.module("kernels/patch_blocks.cu")
    own = text.bind(
        "own_blocks", world.nodes, start=places.corner_start, corners=places.corners,
        patch_gradients=patch_gradients, block=system.block,
    )  # fmt: skip
    others = text.bind(
        "blocks", len(system.sums), start=places.pair_start, pairs=places.pairs, patch_gradients=patch_gradients,
        sums=system.sums,
    )  # fmt: skip
    return own, others
