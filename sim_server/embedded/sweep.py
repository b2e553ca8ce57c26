# SPDX-License-Identifier: MIT
"""One scene at many values: a run for each, in processes beside each other, and a table of what came out."""

import csv
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import track
from rich.table import Table as Drawn

from protocol import messages_pb2 as pb
from sim_server.backends.cpu.processors import usable_processors
from sim_server.embedded.scene import Scene
from sim_server.embedded.simulation import Simulation
from sim_server.errors import InputError

Measure = Callable[[Simulation], Mapping[str, Any]]
ALONE = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}  # runs share the cores by processes
ERROR = "error"  # column of runs that failed


class Table(Sequence[dict[str, Any]]):
    """Rows of a sweep, one for each run, in the order of its values; pandas.DataFrame(table) takes it as it is.

    table["NAME"]: a column as an array, NaN where a run failed; table[k]: row k. print(table) draws it.
    """

    def __init__(self, rows: list[dict[str, Any]]):
        self.rows = rows

    @property
    def columns(self) -> list[str]:
        """Names of all columns: the keys that were varied, then what was measured; `error` where a run failed."""
        return list(dict.fromkeys(name for row in self.rows for name in row))

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return iter(self.rows)

    def __getitem__(self, which: Any) -> Any:
        if not isinstance(which, str):
            return self.rows[which]
        if which not in self.columns:
            raise KeyError(f"no column {which!r}; there is {', '.join(self.columns)}")
        return np.array([row.get(which, "" if which == ERROR else np.nan) for row in self.rows])

    def save(self, path: str | Path) -> Path:
        """Writes it as a CSV file; returns its path. Raises OSError."""
        with Path(path).open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self.columns)
            writer.writeheader()
            writer.writerows(self.rows)
        return Path(path)

    def __str__(self) -> str:
        drawn = Drawn(*self.columns)
        for row in self.rows:
            drawn.add_row(*(_text(row.get(name, "")) for name in self.columns))
        console = Console(width=max(80, 16 * len(self.columns)))
        with console.capture() as text:
            console.print(drawn)
        return text.get().rstrip("\n")


def sweep(
    scene: Scene | Mapping[str, Any] | str | Path, grid: Mapping[str, Sequence[Any]] | Sequence[Mapping[str, Any]],
    seconds: float, measure: Measure | None = None, *, device: str = "cpu", workers: int = 1,
    processes: int | None = None, executor: Any = None,
) -> Table:  # fmt: skip
    """Runs a scene for `seconds` [s] of simulation with each combination of values; returns a Table.

    grid: lists of values by key, as of Scene.with_values, of which all combinations are run; or a list of such values,
    one table for each run. measure: a function of the Simulation after these seconds, which returns numbers or texts
    by name, columns of their own; with seconds = 0 it makes the steps itself. device, workers: as of Simulation.

    Runs are beside each other in `processes`, half as many as the machine has cores if left out, 1 on a GPU; with 1 in
    this process. executor: what runs them instead, e.g. submitit.AutoExecutor for Slurm, whose runs become one array of
    jobs; anything whose `submit(function, *arguments)` returns what has `result()`.

    Columns beside those of grid and measure: mean of iterations, largest true residual, part of the steps that
    converged, median wall time of a step [ms], and by object how far its node farthest from where it began is from
    there [m]; `lost` names objects that ran away. A run that fails has `error`, and the others go on. Raises InputError
    before the first run for values that the scene does not take.
    """
    scene = scene if isinstance(scene, Scene) else Scene.load(scene) if isinstance(scene, str | Path) else Scene(scene)
    points = _points(grid)
    if not np.isfinite(seconds) or seconds < 0 or (seconds == 0 and measure is None):
        raise InputError(f"sweep: seconds = {seconds}: must be above 0, or 0 with a function that makes the steps")
    jobs = [(_checked(scene, values), seconds, measure, device, workers) for values in points]
    found = run_all(jobs, executor, (1 if device == "gpu" else _half()) if processes is None else processes)
    return Table([{**values, **row} for values, row in zip(points, found, strict=True)])


def run(scene: Scene, seconds: float, measure: Measure | None, device: str, workers: int) -> dict[str, Any]:
    """Makes one run and returns its row; of one that fails, its error."""
    try:
        with Simulation(scene, device, workers=workers) as simulation:
            steps = round(seconds / scene.checked.dt)
            row = _usual(simulation, simulation.step(max(1, steps))) if seconds else {}
            return row | dict(measure(simulation) if measure is not None else {})
    except Exception as error:  # of a run, or of a function of the user's: told in its row
        return {ERROR: f"{type(error).__name__}: {error}"}


def _usual(simulation: Simulation, records: NDArray[Any]) -> dict[str, Any]:
    """What every run tells."""
    return {
        "iterations": float(records["iterations"].mean()),
        "residual": float(records["residual"].max()),
        "converged": float((records["status"] == pb.CONVERGED).mean()),
        "step_ms": float(1e3 * np.median(records["whole"])),
        **{
            f"{name}.moved": float(np.linalg.norm(simulation.displacements(name), axis=1).max())
            for name in simulation.objects
        },
        **({"lost": " ".join(simulation.lost)} if simulation.lost else {}),
    }


def _points(grid: Mapping[str, Sequence[Any]] | Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Returns the values of each run by key. Raises InputError for a grid without runs."""
    if isinstance(grid, Mapping):
        for key, values in grid.items():
            if isinstance(values, str) or not isinstance(values, Sequence | np.ndarray):
                raise InputError(f"sweep: {key} = {values!r}: must be a list of values")
        made = [dict(zip(grid, values, strict=True)) for values in product(*grid.values())]
    else:
        made = [dict(values) for values in grid]
    if not made:
        raise InputError("sweep: there is no combination of values to run")
    return made


def _checked(scene: Scene, values: Mapping[str, Any]) -> Scene:
    try:
        return scene.with_values(values)
    except InputError as error:
        raise InputError(f"sweep: {', '.join(f'{k} = {v}' for k, v in values.items())}: {error}") from None


def run_all(jobs: list[tuple[Any, ...]], executor: Any, processes: int) -> Iterator[dict[str, Any]]:
    """Yields the rows of jobs in their order."""
    if processes < 1:
        raise InputError(f"sweep: processes = {processes}: must be 1 or more")
    if executor is not None:
        with executor.batch() if hasattr(executor, "batch") else nullcontext():
            waiting = [executor.submit(run, *job) for job in jobs]
        yield from _shown((_result(each) for each in waiting), len(jobs))
    elif processes == 1 or len(jobs) == 1:
        yield from _shown((run(*job) for job in jobs), len(jobs))
    else:
        from loky import ProcessPoolExecutor  # processes that need no guard in the user's script

        with ProcessPoolExecutor(min(processes, len(jobs)), env=ALONE) as pool:
            waiting = [pool.submit(run, *job) for job in jobs]
            yield from _shown((_result(each) for each in waiting), len(jobs))


def _shown(rows: Iterable[dict[str, Any]], count: int) -> Iterator[dict[str, Any]]:
    """Yields rows; shows on a terminal how many of them there are."""
    where = Console(stderr=True)
    yield from track(rows, "runs", count, console=where, transient=True, disable=not sys.stderr.isatty())


def _result(waiting: Any) -> dict[str, Any]:
    """Returns the row of a run in another process; of one that ended without a row, why."""
    try:
        row: dict[str, Any] = waiting.result()
        return row
    except Exception as error:  # the process was killed, or what it was to run could not be sent
        first, *more = f"{type(error).__name__}: {error}".strip().splitlines()
        return {ERROR: f"{first} {more[-1].strip()}" if more else first}  # of a trace: what it is of, and its end


def _half() -> int:
    """Half of the cores that this process may use: a thread that makes factors stands beside the steps of each run."""
    return max(1, usable_processors() // 2)


def _text(value: Any) -> str:
    return f"{value:.5g}" if isinstance(value, float) else str(value)
