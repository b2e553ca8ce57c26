# SPDX-License-Identifier: MIT
"""Launches of a scene by their place in a step on a GPU."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

from sim_server.backends.base import EngineInput
from sim_server.backends.gpu.device import DeviceLaunch
from sim_server.backends.gpu.kernel_fusion import DOMAINS

Launches = Sequence[DeviceLaunch]


@dataclass(frozen=True)
class StepLaunches:
    """Launches of a scene by their place in a step, in the order in which they run.

    history: begin a step, once
    first: come before the assembly, since their items are of no domain that is fused
    assembly: make A and the right-hand side
    detection: those of the assembly that read what the others make
    substep_forces: the assembly of a step that evaluates forces many times; `assembly` is empty then
    settled: follow the solve, before what moves nodes
    integration: move nodes
    """

    history: Launches
    first: Launches
    assembly: Launches
    detection: Launches
    substep_forces: Launches
    settled: Launches
    integration: Launches

    @classmethod
    def of(cls, given: EngineInput) -> "StepLaunches":
        """Returns those of a scene."""
        before, after, history = (cast(Launches, part) for part in (given.assemble, given.integrate, given.history))
        first, settled = _leading(before), _leading(after)
        assembly, substep_forces = before[first:], before[:0]
        if given.substeps:
            assembly, substep_forces = substep_forces, assembly
        detection = [launch for launch in assembly if launch.domain not in DOMAINS] if given.contact else []
        return cls(history, before[:first], assembly, detection, substep_forces, after[:settled], after[settled:])


def _leading(launches: Launches) -> int:
    """Returns how many launches come first that are of no domain that is fused."""
    return next((k for k, launch in enumerate(launches) if launch.domain in DOMAINS), len(launches))
