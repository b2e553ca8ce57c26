# SPDX-License-Identifier: MIT
"""Correction of factors on a GPU for grabs and contacts that they do not know (correction_state.cuh): its memory."""

from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.base import EngineInput
from sim_server.backends.gpu.cupy_types import DeviceArray
from sim_server.backends.gpu.device import DeviceLaunch, Gpu
from sim_server.backends.gpu.state import device_arrays
from sim_server.backends.gpu.structs import CORRECTION
from sim_server.backends.state import StateArray

HISTORY, MOST_CORRECTED = CORRECTION.constant("HISTORY"), CORRECTION.constant("MOST_CORRECTED")
CORRECTION_ARGUMENTS, CORRECTED_BODY = CORRECTION.dtype("Correction"), CORRECTION.dtype("CorrectedBody")
SPRING_HISTORY = CORRECTION.dtype("SpringHistory")
MOST_BYTES = 1 << 30  # of all columns


class FactorCorrection:
    """Memory of the correction, for all bodies of a scene.

    most: nodes of a body that are corrected
    ranges: nodes [first, last) of each body
    touch: launch of effects/touch.cu, whose springs are corrected; None: no object can be touched
    sites: number of nodes with rows of contact

    params: argument of pcg.cu
    bodies: (bodies,) of CORRECTED_BODY, on the device
    """

    def __init__(self, gpu: Gpu, most: int, ranges: list[tuple[int, int]], touch: DeviceLaunch | None, sites: int):
        cp, nodes, bodies = gpu.cp, max(last for _, last in ranges), len(ranges)
        capacity = max(1, min(most, MOST_CORRECTED, MOST_BYTES // (36 * nodes)))
        width = -(-3 * capacity // 4) * 4
        state = np.zeros(bodies, CORRECTED_BODY)
        state["step"] = -1
        self.bodies: DeviceArray = cp.asarray(state.view(np.uint8))
        self._memory: dict[str, DeviceArray] = {
            "bodies": self.bodies, "difference": cp.zeros((nodes, 6)), "share": cp.zeros(nodes, np.float32),
            "columns": cp.zeros((3 * nodes, width), np.float32),
            "inner": cp.zeros((bodies, width, width), np.float32),
            "scratch": cp.zeros((bodies, 9 * capacity**2 + 18 * capacity)),
        }  # fmt: skip
        if touch:
            self._memory |= {
                "spring": touch.arrays["spring"],
                "springs": cp.zeros(nodes * SPRING_HISTORY.itemsize, np.uint8),
            }
        if sites:
            self._memory["blocks_then"] = cp.zeros((HISTORY, sites, 6), np.float32)
        self.params: NDArray[Any] = np.zeros((), CORRECTION_ARGUMENTS)
        for name, array in self._memory.items():
            self.params[name] = array.data.ptr
        self.params["capacity"], self.params["width"], self.params["sites"] = capacity, width, sites
        self.params["spring_scale"] = np.prod(touch.arrays["coefficients"].get().astype(float)) if touch else 0

    def state(self) -> list[StateArray]:
        """Returns what is known of the changes since the matrix of the factor in use."""
        return device_arrays("engine.correction", self._memory, "bodies", "columns", "inner", "springs", "blocks_then")

    @classmethod
    def wanted(cls, gpu: Gpu, given: EngineInput) -> "FactorCorrection | None":
        """Returns the correction of a scene that can have one: with factors, grabs or obstacles, and no Rosenbrock-W
        steps."""
        contact = given.contact
        # rows of triangles couple nodes, so that own blocks are not all that they change
        sites = int(contact.body_start[-1]) // 2 if contact and not contact.faces else 0
        if not (given.solver.woodbury and given.solver.wants_factors and (given.touch or sites)) or given.stages:
            return None
        return cls(gpu, given.solver.woodbury, list(given.ranges), cast(DeviceLaunch | None, given.touch), sites)

    def connect(self, pair: DeviceArray, base: DeviceArray, contact: NDArray[Any]) -> None:
        """Gives the correction what contact.cu has of nodes and blocks, and its arguments the history.

        pair: (nodes,), base: (sites, 3, 3), contact: CONTACT_ARGUMENTS
        """
        if "blocks_then" in self._memory:
            self.params["pair"], self.params["base"] = pair.data.ptr, base.data.ptr
        for name in ("spring", "springs", "blocks_then", "spring_scale"):
            contact[name] = self.params[name]
