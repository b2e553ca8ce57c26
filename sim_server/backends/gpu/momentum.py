# SPDX-License-Identifier: MIT
"""Momenta of bodies that nothing holds, in the Rosenbrock-W step on a GPU: memory and arguments of momentum.cu."""

from itertools import pairwise
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int32
from sim_server.backends.declarations import Declarations
from sim_server.backends.energies import Energies
from sim_server.backends.gpu.cupy_types import DeviceArray, KernelFunction
from sim_server.backends.gpu.device import DeviceLaunch, Gpu
from sim_server.backends.gpu.kernel_fusion import Epilogue
from sim_server.backends.rosenbrock import Rosenbrock

MOMENTUM = Declarations("backends/gpu/momentum.cu")
FREE_BODIES, NODE_CHUNK, SUMS = (MOMENTUM.dtype(name) for name in ("FreeBodies", "NodeChunk", "MomentumSums"))
FROM_FINISH = (
    "rotation", "share", "weight", "start_x", "start_v", "first", "x", "v", "predictor", "damping_velocity",
    "inertial_increment", "dv",
)  # fmt: skip


class FreeMomenta:
    """Sets the momenta of the bodies of a scene that have no fixed nodes.

    b: device array (nodes, 3) of the right-hand sides, in the frames of the nodes
    items: nodes of a thread block of the nodal kernels
    """

    def __init__(self, gpu: Gpu, stages: Rosenbrock, energies: Energies, b: DeviceArray, items: int):
        cp, finish = gpu.cp, cast(DeviceLaunch, stages.finish)
        self.items = items
        chunks, first_chunk = chunks_of_blocks(energies.starts, stages.unheld, items)
        self._chunks, self._h = len(chunks), float(finish.params["h"])
        self._memory: dict[str, DeviceArray] = {name: finish.arrays[name] for name in FROM_FINISH} | {
            "chunks": cp.asarray(chunks.view(np.int32)), "first_chunk": cp.asarray(first_chunk),
            "sums": cp.zeros(SUMS.itemsize * len(chunks), np.uint8), "mass": gpu.twin(energies.mass),
            "b": b, "first_b": cp.zeros(b.shape, b.dtype),
        }  # fmt: skip
        if "spring" in energies.touch:
            spring = gpu.twin(energies.touch["spring"])
            self._memory |= {"spring": spring, "first_spring": cp.zeros(spring.shape, spring.dtype)}

    def epilogue(self, function: str, decision: NDArray[Any]) -> Epilogue:
        """Returns the epilogue of a nodal kernel. decision: STAGE_DECISION."""
        return Epilogue(MOMENTUM.checked(), "FreeBodies", function, self.params(decision), reads=True)

    def params(self, decision: NDArray[Any]) -> NDArray[Any]:
        """Returns the arguments of the kernels."""
        params = np.zeros((), FREE_BODIES)
        params["decision"], params["h"] = decision, self._h
        for name, array in self._memory.items():
            params[name] = array.data.ptr
        return params

    def launch(self, set_momenta: KernelFunction, decision: NDArray[Any]) -> None:
        """Launches the kernel set_momenta, with which the step ends."""
        set_momenta((self._chunks,), (self.items,), (self.params(decision),))


def chunks_of_blocks(starts: Int32, unheld: Int32, items: int) -> tuple[NDArray[Any], Int32]:
    """Returns the nodes of bodies that may be free, cut where a thread block ends, and the first chunk of each one.

    starts: (bodies + 1,), first node of each body. unheld: (bodies,), 1: a body without fixed nodes. items: nodes of a
    thread block.
    """
    found: list[tuple[int, ...]] = []
    blocks = -(-int(starts[-1]) // items)
    for body in map(int, np.flatnonzero(unheld)):
        first, last = int(starts[body]), int(starts[body + 1])
        edges = [first, *range((first // items + 1) * items, last, items), last]
        at, count = len(found), len(edges) - 1
        found += [(body, a, b, at, count) for a, b in pairwise(edges)]
    chunks = np.array(found, NODE_CHUNK)
    return chunks, np.searchsorted(chunks["begin"], items * np.arange(blocks + 1)).astype(np.int32)
