# SPDX-License-Identifier: MIT
"""The loop of a haptic device: reads it, moves an obstacle with it, renders the force of the coupling, each period."""

from __future__ import annotations

import time
from collections.abc import Callable

from clients.client import Client
from clients.haptics.coupling import VirtualCoupling
from clients.haptics.device import Device
from clients.haptics.latency import Latency
from clients.obstacle import Obstacle
from protocol import messages_pb2 as pb


class HapticLoop:
    """Couples a device to an obstacle with moved = "client". What the obstacle feels comes in zenoh's own thread.

    latency: of what came so far
    late: periods that began more than half a period after their time
    """

    def __init__(self, client: Client, obstacle: Obstacle, device: Device, coupling: VirtualCoupling) -> None:
        self._client, self._obstacle, self._device, self._coupling = client, obstacle, device, coupling
        self.latency = Latency(client.id, obstacle.name, client.status().dt)
        self.late = self.periods = 0
        self._force = (0.0, 0.0, 0.0)

    def run(self, seconds: float, clock: Callable[[], float] = time.monotonic) -> None:
        """Runs for so long [s]. Raises BadInput if the server refuses to move the obstacle."""
        forces = self._client.listen(self._take)
        try:
            due = clock()
            end = due + seconds
            while due < end:
                force = self._coupling.update(self._device.position(), self._force)
                self._device.render(force)
                assert self._coupling.proxy is not None
                at = clock()
                number = self._obstacle.move(self._coupling.proxy)
                assert number is not None
                self.latency.sent(number, at)
                due += self._coupling.period
                self.periods += 1
                left = due - clock()
                if left > 0:
                    time.sleep(left)
                elif left < -0.5 * self._coupling.period:
                    self.late += 1
                    due = clock()  # does not chase lost time: the moves would come together
        finally:
            forces.close()

    def _take(self, batch: pb.Steps, now: float) -> None:
        step = max((each.step for each in batch.steps), default=0)
        found = [
            r for each in batch.steps if each.step == step for r in each.reactions if r.obstacle == self._obstacle.name
        ]
        self._force = (
            sum(r.force.x for r in found), sum(r.force.y for r in found), sum(r.force.z for r in found),
        )  # fmt: skip
        self.latency.came(batch, now)
