# SPDX-License-Identifier: MIT
"""Options of a load test, checked."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from clients.errors import BadInput

DEVICES = ("auto", "cpu", "gpu")


@dataclass(frozen=True)
class LoadOptions:
    """What a load test does. Raises BadInput for a value out of range.

    connect: endpoints of a running server to load; None starts one.
    """

    objects: int
    tets: tuple[int, int]
    clients: int
    rate: float  # commands a second of each client
    seconds: float  # of the load
    workers: int  # of the server that is started
    seed: int  # of the scene and of the disturbances
    device: str
    out: Path | None  # folder to leave scene, log and report in
    connect: list[str] | None
    server: str
    quiet: float = 3.0  # s that steps are measured before the clients begin

    def __post_init__(self) -> None:
        low, high = self.tets
        _within("--objects", self.objects, 1, 4096)
        _within("--clients", self.clients, 0, 256)
        _within("--rate", self.rate, 0.1, 2000.0)
        _within("--seconds", self.seconds, 0.5, 86_400.0)
        _within("--quiet", self.quiet, 0.0, 3600.0)
        _within("--workers", self.workers, 0, 64)
        _within("--seed", self.seed, 0, 2**63)
        if not 6 <= low <= high <= 100_000:
            raise BadInput(f"--tets {low}..{high}: allowed are two numbers of 6 to 100000, the smaller one first")
        if self.device not in DEVICES:
            raise BadInput(f"--device {self.device}: allowed are {', '.join(DEVICES)}")


def _within(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise BadInput(f"{name} {value:g}: allowed is {low:g} to {high:g}")


def span(text: str) -> tuple[int, int]:
    """Parses "200..3000" or one number for both ends. Raises BadInput."""
    low, dots, high = text.partition("..")
    try:
        return int(low), int(high if dots else low)
    except ValueError:
        raise BadInput(f"--tets {text}: allowed is a number, or two as in 200..3000") from None
