# SPDX-License-Identifier: MIT
"""A virtual coupling between a haptic device and an obstacle that is moved with it.

Between the device at d and a proxy at p, where the obstacle is sent, is a spring of stiffness k; the hand feels
f = k (p - d). The proxy has no mass: it goes where the spring and the force F on the obstacle that came last balance
the damping b, b dp/dt = k (d - p) + F. It is integrated implicitly. What the simulation does between two of its steps,
and how late F is, reaches the hand only through the spring (Colgate, Stanley and Brown, Issues in the haptic display of
tool use, IROS 1995). In the air, where no force has come for a while, b is small, so that the hand feels no drag.
"""

from __future__ import annotations

from collections.abc import Sequence

from clients.errors import BadInput

Point = tuple[float, float, float]
HELD = 5.0  # delays after the last force for which the proxy is damped on: it may only have bounced


def largest_stiffness(damping: float, period: float) -> float:
    """Returns the stiffness [N/m] that a device of this damping [N s/m] may render at this period [s].

    A sampled spring is passive up to k = 2 b / T (Colgate and Schenkel, Passivity of a class of sampled-data systems,
    1997).
    """
    return 2 * damping / period


class VirtualCoupling:
    """The spring and the proxy.

    stiffness [N/m] of the spring. delay [s]: of the force, from the move that it answers; the damping of a proxy that
    touches is stiffness times that, with which it comes to rest on what is as stiff as the spring, or softer.
    period [s]: of the device.
    device_damping [N s/m]: what the device and the hand have of their own; bounds the stiffness.
    speed [m/s]: that the obstacle is moved with at most (max_speed of the scene).
    Raises BadInput for a stiffness above `largest_stiffness`, or numbers that are not above 0.
    """

    def __init__(
        self, stiffness: float, delay: float, period: float = 1e-3, device_damping: float = 1.0,
        speed: float = float("inf"),
    ) -> None:  # fmt: skip
        if not min(stiffness, delay, period, device_damping, speed) > 0:
            raise BadInput("stiffness, delay, period, device_damping and speed of a coupling must be above 0")
        most = largest_stiffness(device_damping, period)
        if stiffness > most:
            raise BadInput(
                f"stiffness {stiffness:g} N/m: a device with a damping of {device_damping:g} N s/m can render "
                f"{most:g} N/m each {period:g} s without giving off energy"
            )
        self.stiffness, self.period, self.speed = stiffness, period, speed
        self.delay = max(delay, period)
        self._air = HELD * self.delay  # time since a force came [s]
        self.proxy: Point | None = None

    def update(self, device: Sequence[float], force: Sequence[float]) -> Point:
        """Moves the proxy by one period; returns the force on the hand [N].

        device: where it is [m]. force: on the obstacle, that came last [N]
        """
        k, h = self.stiffness, self.period
        self._air = 0.0 if any(force) else self._air + h
        b = k * (self.delay if self._air < HELD * self.delay else h)
        at = self.proxy or (device[0], device[1], device[2])
        aim = [(b * p + h * (k * d + f)) / (b + h * k) for p, d, f in zip(at, device, force, strict=True)]
        move = [a - p for a, p in zip(aim, at, strict=True)]
        size = sum(m * m for m in move) ** 0.5
        part = min(1.0, self.speed * h / size) if size > 0 else 1.0
        x, y, z = (p + part * m for p, m in zip(at, move, strict=True))
        self.proxy = x, y, z
        fx, fy, fz = (k * (p - d) for p, d in zip(self.proxy, device, strict=True))
        return fx, fy, fz
