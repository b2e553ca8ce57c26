# SPDX-License-Identifier: MIT
"""Live curves of the last seconds: iterations, age of the factor, true residual, step time against the time step."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb

if TYPE_CHECKING:
    import viser

SECONDS = 10.0  # of simulation that are shown
POINTS = 250  # of a curve at most; each is the largest value of the steps in its part of the time
OWN = 3  # objects that have curves of their own; of more the largest value is shown
COLORS = ("#0072b2", "#d55e00", "#009e73")
HEIGHT = 120  # pixels


FIELDS = ("iterations", "age", "residual", "milliseconds")  # age: steps; residual: log10


@dataclass
class Bin:
    """The largest values of the steps in a part of the time. time: of its first step [s]"""

    time: float
    values: list[list[float]]  # of each curve and field; -inf: none


class History:
    """Largest values in each part of the last seconds: a curve for each object, or one for all if they are many."""

    def __init__(self, objects: Iterable[str]) -> None:
        objects = list(objects)
        own = len(objects) <= OWN
        self.names = objects if own else ["largest"]
        self._curve = {name: number if own else 0 for number, name in enumerate(objects)}
        self._last: dict[str, float] = {}  # time of the newest step of an object
        self._bins: dict[int, Bin] = {}

    def add(self, steps: Iterable[pb.ObjectStep]) -> None:
        """Adds steps; one that is earlier than the last, of a run put back to its start, begins anew."""
        for step in steps:
            name, time = step.header.object, step.time
            curve = self._curve.get(name)
            if curve is None:
                continue
            if time <= self._last.get(name, -math.inf):
                self._bins.clear()
                self._last.clear()
            self._last[name] = time
            values = self._bin(time).values[curve]
            new = (
                float(step.iterations), float(step.factor_age) if step.factor_age >= 0 else -math.inf,
                math.log10(max(step.residual, 1e-16)), 1e3 * step.step_seconds,
            )  # fmt: skip
            for field, value in enumerate(new):
                if value > values[field]:
                    values[field] = value

    def _bin(self, time: float) -> Bin:
        number = int(time / SECONDS * POINTS)
        found = self._bins.get(number)
        if found is None:
            newest = max(self._bins, default=number)
            for old in [k for k in self._bins if k <= max(newest, number) - POINTS]:
                del self._bins[old]
            found = self._bins[number] = Bin(time, [[-math.inf] * len(FIELDS) for _ in self.names])
        return found

    def columns(self) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
        """Returns times (p,) [s] and for each field the curves (c, p); NaN where there is no value."""
        if not self._bins:
            return np.zeros(1), {field: np.zeros((len(self.names), 1)) for field in FIELDS}
        bins = [self._bins[number] for number in sorted(self._bins)]
        table = np.array([found.values for found in bins])  # (p, c, fields)
        table[np.isneginf(table)] = np.nan
        return np.array([found.time for found in bins]), {f: table[:, :, k].T for k, f in enumerate(FIELDS)}


class Curves:
    """Four charts in the container that is open."""

    def __init__(self, gui: viser.GuiApi, history: History, dt: float) -> None:
        self.history, self._dt = history, dt
        self._charts = {
            "iterations": self._chart(gui, "iterations of a step"),
            "age": self._chart(gui, "age of the factor [steps]"),
            "residual": self._chart(gui, "log10 of the true residual |b - A dv| / |b|"),
            "milliseconds": self._chart(gui, "step [ms], and dt", more=("dt",)),
        }

    def fits(self, history: History, dt: float) -> bool:
        """Returns True if another history can be shown by the same charts."""
        return (history.names, dt) == (self.history.names, self._dt)

    def update(self) -> None:
        """Shows what the history has now."""
        times, columns = self.history.columns()
        for field, chart in self._charts.items():
            values = list(columns[field])
            if field == "milliseconds":
                values = [np.fmax.reduce(values), np.full(len(times), 1e3 * self._dt)]
            chart.data = (times, *values)

    def remove(self) -> None:
        for chart in self._charts.values():
            chart.remove()

    def _chart(self, gui: viser.GuiApi, title: str, more: tuple[str, ...] = ()) -> Any:
        names = ["step", *more] if more else self.history.names
        series = [{"label": "t [s]"}]
        for name, color in zip(names, COLORS, strict=False):
            series.append({"label": name, "stroke": color, "width": 1.5, "points": {"show": False}})  # type: ignore[dict-item]
        return gui.add_uplot(
            data=tuple(np.zeros(1) for _ in series), series=tuple(series), title=title, height=HEIGHT,  # type: ignore[arg-type]
            scales={"x": {"time": False}}, legend={"show": len(names) > 1},
        )  # fmt: skip
