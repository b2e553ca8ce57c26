# SPDX-License-Identifier: MIT
"""Values of the command line of a server."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Options:
    """Values of the command line, by the names of the options; None: not given."""

    scene: Path
    overrides: list[str]
    device: str
    name: str
    listen: list[str] | None
    connect: list[str] | None
    shared_memory: bool
    record: Path | None
    steps: int | None
    realtime: bool
    workers: int
    worker_device: str
    web: str | None
    quiet: bool
    resume: Path | None
    tls: str | None
    insecure: bool
    metrics: str | None
    record_rotate: list[str]
    record_keep: str | None
    max_objects: int | None
    max_memory: str | None
