# SPDX-License-Identifier: MIT
"""The example of a haptic client: a scripted hand that presses an obstacle into what is there, and what it felt."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Any

from rich.table import Table

from clients.client import Client
from clients.errors import BadInput
from clients.haptics.coupling import VirtualCoupling
from clients.haptics.device import Point, ScriptedHand
from clients.haptics.loop import HapticLoop

PERIOD = 1e-3  # s
DEVICE_DAMPING = 1.0  # N s/m, of hand and device
STEPS_OF_DELAY = 3.0  # that forces are expected to be late


def run(
    client: Client, name: str, press: Point, rate: float, stiffness: float, delay: float, seconds: float
) -> dict[str, Any]:
    """Runs the example, from where the obstacle is. Raises BadInput, ClientError."""
    status = client.status(fresh=True)
    place = next((pose.position for pose in status.obstacles if pose.header.object == name), None)
    obstacle = client.obstacle(name)
    if obstacle.shape.moved != "client" or place is None:
        raise BadInput(f'obstacle {name!r} is not moved by clients; it needs moved = "client" in the scene')
    start = (place.x, place.y, place.z)
    coupling = VirtualCoupling(stiffness, delay or STEPS_OF_DELAY * status.dt, PERIOD, DEVICE_DAMPING)
    hand = Recorded(ScriptedHand(start, press, rate, time.monotonic))
    loop = HapticLoop(client, obstacle, hand, coupling)
    try:
        loop.run(seconds)
    finally:
        obstacle.move(start)
    found = loop.latency.result()
    return {
        **found,
        "dt_ms": 1e3 * status.dt,
        "periods": loop.periods,
        "late_periods": loop.late,
        "most_felt": hand.most,
    }


class Recorded:
    """A device that remembers the largest force it rendered. most: that [N]"""

    def __init__(self, device: ScriptedHand) -> None:
        self._device, self.most = device, 0.0

    def position(self) -> Point:
        return self._device.position()

    def render(self, force: Sequence[float]) -> None:
        self.most = max(self.most, math.hypot(*force))
        self._device.render(force)


def tables(found: dict[str, Any]) -> Table:
    """Table of the result of `run`."""
    table = Table("", "p50", "p99", "largest")
    rows = (
        ("from a move to its force, ms", "ms"),
        ("the same, steps", "steps_late"),
        ("jitter of the steps, ms", "jitter_ms"),
    )
    for what, key in rows:
        table.add_row(
            what, *(f"{found[f'{key}_{p}']:.2f}" if f"{key}_{p}" in found else "-" for p in ("p50", "p99", "max"))
        )
    table.caption = (
        f"{found['moves']} moves felt; {found['steps']} steps came, {found.get('steps_per_second', 0.0):.0f} a second, "
        f"{found['missing']} did not; {found['late_periods']} of {found['periods']} periods late; "
        f"at most {found['most_felt']:.3g} N"
    )
    return table
