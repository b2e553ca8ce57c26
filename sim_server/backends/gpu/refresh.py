# SPDX-License-Identifier: MIT
"""Memory of the local refresh of factors on a GPU, where a body has changed most since their matrix
(refresh_state.cuh)."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.base import EngineInput
from sim_server.backends.gpu.cupy_types import DeviceArray
from sim_server.backends.gpu.device import Gpu
from sim_server.backends.gpu.state import device_arrays
from sim_server.backends.gpu.structs import REFRESH
from sim_server.backends.state import StateArray

REFRESH_ARGUMENTS, REFRESHED_BODY = REFRESH.dtype("Refresh"), REFRESH.dtype("RefreshedBody")
REFRESHED_NODES = 1500  # of the largest body: below it an iteration takes less than there is to save
MOST_BODIES = 64
KEPT = 64  # steps whose blocks are kept: an older factor is not refreshed
MOST_BYTES = 256 << 20  # of all these


class LocalRefresh:
    """Memory of the local refresh, for all bodies of a scene.

    ranges: nodes [first, last) of each body
    row_start, columns: pattern of A

    params: argument of pcg.cu
    bodies: (bodies,) of REFRESHED_BODY, on the device
    """

    def __init__(
        self, gpu: Gpu, ranges: Sequence[tuple[int, int]], row_start: NDArray[np.int32], columns: NDArray[np.int32]
    ):
        cp, nodes, bodies = gpu.cp, len(row_start) - 1, len(ranges)
        most, room = REFRESH.constant("REFRESHED_FREEDOMS"), REFRESH.constant("REFRESH_ROOM")
        kept = max(1, min(KEPT, MOST_BYTES // (24 * nodes)))
        state = np.zeros(bodies, REFRESHED_BODY)
        state["slow"] = -1
        self.bodies: DeviceArray = cp.asarray(state.view(np.uint8))
        own_block = np.flatnonzero(columns == np.repeat(np.arange(nodes), np.diff(row_start)))
        self._memory: dict[str, DeviceArray] = {
            "bodies": self.bodies, "own_block": cp.asarray(own_block.astype(np.int32)),
            "blocks_then": cp.zeros((kept, nodes, 6), np.float32), "noted": cp.asarray(np.full((kept, bodies), -1)),
            "score": cp.zeros(nodes, np.float32), "room": cp.zeros((bodies, room)),
            "inner": cp.zeros((bodies, most, most), np.float32), "t": cp.zeros((bodies, most), np.uint64),
        }  # fmt: skip
        self.params: NDArray[Any] = np.zeros((), REFRESH_ARGUMENTS)
        for name, array in self._memory.items():
            self.params[name] = array.data.ptr
        self.params["kept"], self.params["nodes"] = kept, nodes

    def used(self, body: int) -> int:
        """Number of nodes of a body on which its last solve was exact."""
        return int(self.bodies.get().view(REFRESHED_BODY)["used"][body])

    def state(self) -> list[StateArray]:
        """Returns what is known of the matrices of factors, which earlier checkpoints lack."""
        found = device_arrays("engine.refresh", self._memory, "bodies", "blocks_then", "noted")
        return [replace(array, added=True) for array in found]

    @classmethod
    def wanted(cls, gpu: Gpu, given: EngineInput) -> "LocalRefresh | None":
        """Returns the refresh of a scene that can have one: of a large body, with factors that nothing else corrects,
        one solve a step, and solves that end by the residual."""
        many = given.newton or given.stages or given.contact or given.touch or given.cut or given.errors
        solver, largest = given.solver, max(last - first for first, last in given.ranges)
        bounded = solver.budget or solver.step_budget
        wished = solver.wants_factors and solver.preconditioner in ("auto", "cholesky")
        if many or bounded or not wished or largest < REFRESHED_NODES or len(given.ranges) > MOST_BODIES:
            return None
        return cls(gpu, given.ranges, given.arrays["row_start"], given.arrays["columns"])
