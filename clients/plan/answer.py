# SPDX-License-Identifier: MIT
"""Puts a choice into words: what was measured, with how much margin, and what lies next to it."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from clients.accuracy.sources import MESH, length
from clients.accuracy.study import NO_TIME, machine
from clients.plan.front import Budget, Choice, Exactness, Wish, bound
from clients.plan.measurements import Measurement, Measurements
from protocol.printable import printable

if TYPE_CHECKING:
    from rich.table import Table


@dataclass(frozen=True)
class Answer:
    """A choice for a wish.

    untried: settings that were measured apart only and may be better together, the most promising first
    """

    points: Measurements
    wish: Wish
    choice: Choice
    untried: list[dict[str, str]]

    @property
    def own(self) -> Measurement | None:
        """The scene with its own settings."""
        return next((p for p in self.points.usable if not p.settings), None)

    def first(self) -> str:
        """Returns the first sentence."""
        count, shown = len(self.points.usable), settings(self.choice.point)
        if self.choice.reached:
            best = "the cheapest" if self.wish.cheapest else "the most exact"
            return f"{self.wish}: {best} of {count} measured settings: {shown}"
        nearest = "the most exact ones" if self.wish.cheapest else "the nearest ones"
        return f"{self.wish}: none of {count} measured settings; {nearest}: {shown}"

    def notes(self) -> list[str]:
        """Returns what else there is to say, a sentence each."""
        point, points = self.choice.point, self.points
        told = [self._margin(), *self._reference()]
        if points.found.machine.get("processor", here := machine("")["processor"]) != here:
            told.append(f"measured on another machine ({points.found.machine['processor']}): times differ on this one")
        mesh = points.found.sources.get(MESH)
        if mesh is not None and mesh > point.error:
            about = "at least" if MESH in points.found.at_least else "about"
            told.append(f"the mesh is off by {about} {length(mesh)}, which these settings do not change")
        if point.slowest > 1 >= point.seconds:
            told.append(f"one round took {point.slowest:.3g} s a simulated second: real time is not certain")
        if point.unconverged:
            told.append(f"{point.unconverged} solves did not reach their tolerance")
        if points.lost:
            lost = ", ".join(f"{count} {reason}" for reason, count in points.lost.most_common())
            told.append(f"measurements left out: {lost}")
        if late := sum(left["reason"] == NO_TIME for left in points.found.left_out):
            told.append(f"settings that had no time to be measured: {late}; sim-client accuracy goes on with them")
        if not self.choice.reached and points.found.sentence:
            told.append(printable(points.found.sentence))
        if self.untried:
            told.append(f"measured apart but not together, may be better: {words(self.untried[0])} (--measure MINUTES)")
        return told

    def _margin(self) -> str:
        point = self.choice.point
        if isinstance(self.wish, Budget):
            step = f"p99 {point.p99:.3g} of {self.wish.step:g} ms ({_share(point.p99 / self.wish.step)})"
            return f"{step}, {point.seconds:.3g} of 1 s a simulated second ({_share(point.seconds)})"
        pace = "keeps pace with the clock" if point.seconds < 1 else "is slower than the clock"
        error = bound(point, self.points.floor)
        return (
            f"error at most {error:.2g} of {self.wish.position:g} m ({_share(error / self.wish.position)}); "
            f"{point.seconds:.3g} s a simulated second, which {pace}"
        )

    def _reference(self) -> list[str]:
        """Returns what the uncertainty of the reference leaves open."""
        u, error = self.points.uncertainty, self.choice.point.error
        if u is None:
            return ["how exact the reference is was not measured; the errors are distances from it"]
        if isinstance(self.wish, Exactness) and not self.choice.reached and error <= self.wish.position:
            return [
                f"the distance from the reference is {error:.2g} m, but the reference is uncertain by {u:.2g} m: "
                "a finer one could confirm it"
            ]
        if error <= u:
            return [f"the reference is uncertain by {u:.2g} m: settings with smaller errors are not told apart"]
        return []

    def _figures(self, point: Measurement) -> str:
        """Returns what was measured, in words."""
        u = self.points.uncertainty
        error = f"{point.error:.2g} m" + ("" if u is None else f" (+- {u:.2g} m)")
        iterations = "" if math.isnan(point.iterations) else f", {point.iterations:.3g} iterations a step"
        return (
            f"error {error}, step p50 {point.p50:.3g}, p99 {point.p99:.3g}, max {point.longest:.3g} ms, "
            f"{point.seconds:.3g} s a simulated second{iterations}"
        )

    def _neighbours(self) -> list[tuple[str, Measurement]]:
        found = (("cheaper", self.choice.cheaper), ("more exact", self.choice.more_exact))
        return [(word, point) for word, point in found if point is not None]

    def comments(self, mark: str, use: str) -> list[str]:
        """Returns the comments of an overlay. mark: begins the first one; use: the command that takes the overlay"""
        found, point = self.points.found, self.choice.point
        machine = ", ".join(f"{key} {value}" for key, value in found.machine.items())
        return [
            f"{mark} for {found.scene}: {self.wish}.",
            f"Use: {use}",
            "",
            f"Measured: {self._figures(point)};",
            f"  axis {point.axis!r}, {found.duration:g} s simulated on {found.device} ({machine}).",
            *(f"Next, {word}: {settings(other)}: {self._figures(other)}." for word, other in self._neighbours()),
            f"Digest of the scene: {found.digest}",
        ]

    def as_json(self) -> dict[str, Any]:
        """Returns the answer for programs."""
        found, choice, wish = self.points.found, self.choice, self.wish
        return {
            "scene": found.scene, "digest": found.digest, "device": found.device, "machine": found.machine,
            "wish": {"budget_ms": wish.step} if isinstance(wish, Budget) else {"position": wish.position},
            "reached": choice.reached, "chosen": self._values(choice.point), "cheaper": self._values(choice.cheaper),
            "more_exact": self._values(choice.more_exact), "as_it_is": self._values(self.own),
            "uncertainty": self.points.uncertainty, "notes": self.notes(), "untried": self.untried,
        }  # fmt: skip

    def _values(self, point: Measurement | None) -> dict[str, Any] | None:
        if point is None:
            return None
        floor = self.points.floor
        found = {**asdict(point), "bound": bound(point, floor), "fits": self.wish.fits(point, floor)}
        return {key: None if isinstance(v, float) and math.isnan(v) else v for key, v in found.items()}

    def table(self) -> Table:
        """Returns a table of the choice and its neighbours on the front."""
        from rich.table import Table

        from clients.watch import COMPACT

        found = Table("", "settings", "error, m", "p99, ms", "s per s", "iter.", **COMPACT)
        found.columns[1].overflow = "fold"
        rows = [("chosen" if self.choice.reached else "nearest", self.choice.point), *self._neighbours()]
        if (own := self.own) is not None and all(own is not p for _, p in rows):
            rows.append(("", own))
        for word, p in sorted(rows, key=lambda row: -row[1].error):
            iterations = "-" if math.isnan(p.iterations) else f"{p.iterations:.3g}"
            times = f"{p.p99:.3g}", f"{p.seconds:.3g}", iterations
            found.add_row(word, settings(p, "\n"), f"{p.error:.2g}", *times)
        return found


def settings(point: Measurement, between: str = " ") -> str:
    """Returns settings as they are written on a command line."""
    return words(point.settings, between) or "the scene as it is"


def words(given: dict[str, str], between: str = " ") -> str:
    """Returns KEY=VALUE of each."""
    return between.join(f"{key}={value}" for key, value in given.items())


def _share(used: float) -> str:
    return f"{100 * (1 - used):.0f} % left" if used <= 1 else f"{used:.3g} times too much"
