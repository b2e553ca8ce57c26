# SPDX-License-Identifier: MIT
"""`sim-client plan`: proposes settings from measured points and writes them as an overlay."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clients.errors import BadInput
from clients.plan import overlay, report
from clients.plan.combinations import untried
from clients.plan.front import Choice, Wish, choose
from clients.plan.measurements import Measurements, read
from clients.plan.scene import digest


@dataclass(frozen=True)
class Plan:
    """An answer.

    untried: settings that were measured apart only; to: the overlay written, None if nothing is as wished
    """

    points: Measurements
    wish: Wish
    choice: Choice
    untried: list[dict[str, str]]
    to: Path | None
    use: str

    def as_json(self) -> dict[str, Any]:
        """Returns the answer for programs."""
        found = report.as_json(self.points, self.wish, self.choice, self.untried)
        return {**found, "overlay": str(self.to) if self.to else None, "use": self.use if self.to else None}

    def show(self) -> None:
        """Prints the answer for people."""
        from rich.console import Console

        print(report.answer(self.points, self.wish, self.choice))
        Console().print(report.table(self.points, self.choice))
        for note in report.notes(self.points, self.wish, self.choice, self.untried):
            print(f"- {note}")
        if self.to:
            print(f"wrote {self.to}:\n  {self.use}")


def plan(scene: Path, wish: Wish, where: Path | None, to: Path | None) -> Plan:
    """Proposes settings of a scene and writes them.

    where: of the points, a file or its folder; to: overlay to write; None: beside the scene

    Raises BadInput if there are no points of this scene, or `to` is another file.
    """
    to = to or scene.with_suffix(".plan.toml")
    overlay.check_path(to)
    points = checked(scene, where or scene.with_suffix(".accuracy"))
    choice = choose(points.usable, wish, points.floor)
    device = ["--device", points.found.device] if points.found.device in ("cpu", "gpu") else []
    use = shlex.join(["sim-server", str(scene), *device, "--set", f"@{to}"])
    found = Plan(
        points, wish, choice, untried(points.usable, wish, choice, points.floor), to if choice.reached else None, use
    )
    if choice.reached:
        overlay.write(to, choice.point.settings, report.comments(points, wish, choice, use, overlay.MARK))
    return found


def checked(scene: Path, where: Path) -> Measurements:
    """Reads the points of a scene. Raises BadInput if there are none, or only those of another scene."""
    known = digest(scene)
    first = f"first: sim-client accuracy {shlex.quote(str(scene))}"
    path = where / "points.json" if where.is_dir() or where.suffix != ".json" else where
    if not path.exists():
        raise BadInput(f"{path}: no such file; settings are chosen from what was measured, {first}")
    points = read(path)
    if points.found.digest != known:
        raise BadInput(
            f"{path}: measured of another scene, or of this one with other values (digest {points.found.digest[:12]}, "
            f"{scene} has {known[:12]}); {first}"
        )
    if not points.usable:
        raise BadInput(f"{path}: no measurement has come to its end; {first}")
    return points
