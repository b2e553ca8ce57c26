# SPDX-License-Identifier: MIT
"""Live curves of the last seconds: iterations, age of the factor, true residual, step time against the time step."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb

if TYPE_CHECKING:
    import viser

SECONDS = 10.0  # of simulation that are shown
POINTS = 250  # of a curve; of more steps each point is the largest of several
OWN = 3  # objects that have curves of their own; of more the largest value is shown
COLORS = ("#0072b2", "#d55e00", "#009e73")
HEIGHT = 120  # pixels


class Row(NamedTuple):
    """What is shown of one object and step."""

    time: float
    iterations: float
    age: float  # steps; NaN: no factor
    residual: float  # log10
    milliseconds: float


class History:
    """The rows of the last seconds of each object."""

    def __init__(self, objects: Iterable[str]) -> None:
        self.rows: dict[str, deque[Row]] = {name: deque() for name in objects}

    def add(self, steps: Iterable[pb.ObjectStep]) -> None:
        """Adds steps; one that is earlier than the last, of a run put back to its start, begins anew."""
        for step in steps:
            rows = self.rows.get(step.header.object)
            if rows is None:
                continue
            if rows and step.time <= rows[-1].time:
                rows.clear()
            age = float(step.factor_age) if step.factor_age >= 0 else math.nan
            residual = math.log10(max(step.residual, 1e-16))
            rows.append(Row(step.time, step.iterations, age, residual, 1e3 * step.step_seconds))
            while rows and rows[0].time < step.time - SECONDS:
                rows.popleft()

    def columns(self, field: str) -> tuple[NDArray[np.float64], list[NDArray[np.float64]]]:
        """Returns times and one array per object that has a curve of its own, else one array of the largest values."""
        tables = [np.array(rows, float).reshape(-1, len(Row._fields)) for rows in self.rows.values()]
        length = min((len(t) for t in tables), default=0)
        if not length:
            return np.zeros(1), [np.zeros(1) for _ in range(len(self.names))]
        number = Row._fields.index(field)
        values = np.stack([t[-length:, number] for t in tables])
        if len(tables) > OWN:
            values = np.fmax.reduce(values)[None]  # NaN where all are
        times = tables[0][-length:, 0]
        bins = max(1, math.ceil(length / POINTS))
        starts = np.arange(0, length, bins)
        return times[starts], [np.fmax.reduceat(row, starts) for row in values]

    @property
    def names(self) -> list[str]:
        """Names of the curves."""
        return list(self.rows) if len(self.rows) <= OWN else ["largest"]


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
        for field, chart in self._charts.items():
            times, values = self.history.columns(field)
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
