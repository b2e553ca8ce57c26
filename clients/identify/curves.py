# SPDX-License-Identifier: MIT
"""Measured curves: columns of a CSV file, and the same columns of a simulated run.

time                 [s] since the run began, rising
OBJECT[NODE].y       displacement of a node along y (x, z) [m]; NODE: its number, or X Y Z, the place at rest next to it
OBJECT/NAME.fy       force along y that the object exerts on NAME: a holder, obstacle, attachment or spring [N]

An empty cell was not measured.
"""

from __future__ import annotations

import csv
import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clients.errors import BadInput
from clients.log.reader import Log
from clients.log.scalars import REACTION

Values = NDArray[np.float64]
NAME = r"(?P<object>[A-Za-z0-9_.-]+)"
DISPLACEMENT = re.compile(NAME + r"\[(?P<node>[^\]]+)\]\.(?P<axis>[xyz])")
FORCE = re.compile(NAME + r"/(?P<what>[^/]+)\.f(?P<axis>[xyz])")
FORMS = "time, OBJECT[NODE].x (y, z), OBJECT[X Y Z].x, OBJECT/NAME.fx (fy, fz)"
MOST_ROWS, MOST_COLUMNS = 1_000_000, 1000


@dataclass(frozen=True)
class Column:
    """One measured quantity. node: a number, or three coordinates at rest [m]; what: that a force is on, else empty."""

    title: str
    object: str
    axis: int
    node: tuple[float, ...] = ()
    what: str = ""


@dataclass(frozen=True)
class Curves:
    """The content of a file. times (k,) [s]; values (k, columns) [m] or [N], NaN where nothing was measured."""

    path: Path
    columns: list[Column]
    times: Values
    values: Values

    @property
    def duration(self) -> float:
        """Time of the last row [s]."""
        return float(self.times[-1])

    @property
    def weights(self) -> Values:
        """Of each cell (k, columns): so that the squares of a column, each over its largest value, have the mean 1 /
        columns at most; 0 where nothing was measured."""
        known = np.isfinite(self.values)
        largest = np.nanmax(np.abs(self.values), axis=0)
        return known / (largest * np.sqrt(known.sum(axis=0) * len(self.columns)))

    def residual(self, simulated: Values) -> Values:
        """Returns what a run is off by, weighted, of the measured cells (m,); its norm is the misfit, relative."""
        weighted = self.weights * (simulated - np.nan_to_num(self.values))
        found: Values = weighted[np.isfinite(self.values)]
        return found

    def simulated(self, log: Log) -> Values:
        """Returns the columns of a run at the measured times (k, columns), straight between steps.

        Raises BadInput for what is not in the log: it names file, column and what there is.
        """
        found = [self._of(log, column) for column in self.columns]
        return np.stack(found, axis=1)

    def _of(self, log: Log, column: Column) -> Values:
        try:
            log.object_log(column.object)
        except BadInput:
            raise self._bad(column, f"no object {column.object!r}; there is {', '.join(sorted(log.objects))}") from None
        return self._force(log, column) if column.what else self._displacement(log, column)

    def _displacement(self, log: Log, column: Column) -> Values:
        first = log.frame(column.object, 0)
        rest = log.mesh(column.object, first.epoch).rest
        if len(column.node) == 3:
            node = int(np.linalg.norm(rest - np.array(column.node), axis=1).argmin())
        else:
            node = int(column.node[0])
            if node >= len(rest):
                raise self._bad(column, f"no node {node}; {column.object!r} has nodes 0 to {len(rest) - 1}")
        frames = [(f.time, f.x[node, column.axis]) for f in log.frames(column.object) if f.epoch == first.epoch]
        times, x = np.array(frames).T
        return np.interp(self.times, times, x - first.x[node, column.axis])

    def _force(self, log: Log, column: Column) -> Values:
        steps = log.scalars(column.object)
        key = f"{REACTION}{column.what}/force_{'xyz'[column.axis]}"
        if key not in steps:
            names = {name.split("/")[1] for name in steps if name.startswith(REACTION)}
            there = f"there are forces on {', '.join(sorted(names))}" if names else "it exerts none on anything named"
            raise self._bad(column, f"no force of {column.object!r} on {column.what!r}; {there}")
        return np.interp(self.times, steps["time"], steps[key])

    def _bad(self, column: Column, text: str) -> BadInput:
        return BadInput(f"{self.path}, column {column.title!r}: {text}")


def read(path: Path) -> Curves:
    """Reads a CSV file. Raises BadInput that names file, column and line."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = csv.reader(file, strict=True)
            titles = [title.strip() for title in next(lines, [])]
            columns = _columns(path, titles)
            rows = []
            for cells in lines:
                if any(cell.strip() for cell in cells):
                    rows.append(_row(path, titles, cells, lines.line_num))
                if len(rows) > 1 and not rows[-1][0] > rows[-2][0]:
                    raise _at(path, "time", lines.line_num, f"{rows[-1][0]:g} after {rows[-2][0]:g}: times must rise")
                if len(rows) > MOST_ROWS:
                    raise BadInput(f"{path}: at most {MOST_ROWS:,} lines")
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BadInput(f"{path}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if not rows or not rows[-1][0] > 0:
        raise BadInput(f"{path}: needs a line with a time above 0 s")
    table = np.array(rows)
    found = Curves(path, columns, table[:, 0], table[:, 1:])
    for column, values in zip(columns, found.values.T, strict=True):
        if not np.nan_to_num(values).any():
            raise BadInput(f"{path}, column {column.title!r}: needs a number other than 0")
    return found


def _columns(path: Path, titles: list[str]) -> list[Column]:
    if not titles or titles[0] != "time":
        first = titles[0] if titles else ""
        raise BadInput(f"{path}, column 1, line 1: {first[:80]!r}: must be time; columns are {FORMS}")
    if not 2 <= len(titles) <= MOST_COLUMNS:
        raise BadInput(f"{path}, line 1: needs 1 to {MOST_COLUMNS - 1} columns beside time: {FORMS}")
    for title in titles:
        if titles.count(title) > 1:
            raise BadInput(f"{path}, column {title!r}, line 1: is there twice")
    return [_column(path, title) for title in titles[1:]]


def _column(path: Path, title: str) -> Column:
    if match := FORCE.fullmatch(title):
        return Column(title, match["object"], "xyz".index(match["axis"]), what=match["what"])
    if match := DISPLACEMENT.fullmatch(title):
        try:
            node = tuple(float(word) for word in match["node"].split())
        except ValueError:
            node = ()
        whole = len(node) == 1 and node[0].is_integer() and node[0] >= 0
        if whole or (len(node) == 3 and all(map(math.isfinite, node))):
            return Column(title, match["object"], "xyz".index(match["axis"]), node)
    raise BadInput(f"{path}, column {title[:80]!r}, line 1: allowed are {FORMS}")


def _row(path: Path, titles: list[str], cells: list[str], line: int) -> list[float]:
    if len(cells) != len(titles):
        raise BadInput(f"{path}, line {line}: {len(cells)} cells; line 1 has {len(titles)} columns")
    return [_cell(path, title, cell.strip(), line) for title, cell in zip(titles, cells, strict=True)]


def _cell(path: Path, title: str, cell: str, line: int) -> float:
    if not cell and title != "time":
        return math.nan
    try:
        value = float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or (title == "time" and value < 0):
        raise _at(path, title, line, f"{cell[:80]!r}: must be a finite number" + " from 0 on" * (title == "time"))
    return value


def _at(path: Path, title: str, line: int, text: str) -> BadInput:
    return BadInput(f"{path}, column {title!r}, line {line}: {text}")
