# SPDX-License-Identifier: MIT
"""What cuts cost: iterations right after a cut with factors from before it, and steps while a body is cut."""

import statistics
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from sim_server.effects.cutting import Cutting
from sim_server.mechanics.cut_shapes import border
from sim_server.mechanics.numbers import text_of
from sim_server.mechanics.splitting import opening
from sim_server.scene import where
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.harness.report import Report, plots

SCENE = {
    "name": "cutting", "dt": 0.02, "effects": {"gravity": {"g": [0, -9.81, 0]}},
    "object": [{"name": "beam", "density": 1000.0, "effects": {
        "corotational": {"young": 1e6, "poisson": 0.45}, "rayleigh": {"mass": 0.1},
        "fixed": {"where": "Z < 0.01"}, "cutting": True}}],
}  # fmt: skip
CUTS = {  # what is removed of the beam of 1 x 1 x 4 m
    "one element": "0", "surface, ten": "10", "slit": "abs(Z - 2) < 0.1 and Y > 0.5", "corner": "Z > 3.4 and Y > 0.5",
    "through": "abs(Z - 2) < 0.1", "a third, scattered": "1000",
}  # fmt: skip
METHODS = ("block Jacobi", "plain old factor", "corrected old factor", "new factor")
TIMED = ("block Jacobi", "corrected old factor")
BEFORE, AFTER, AGE = 14, 3, 6  # steps; the factor's age at the cut, at most
EXPLAINED = (
    "The beam of the README (1 x 1 x 4 m, E = 1 MPa, nu = 0.45, linear elements, dt = 20 ms, backward Euler, tolerance "
    "1e-6) is let go; after some steps elements are removed. Corotational elements, lockstep, so that each run has the "
    "same factors: made at most six steps before the cut, and none that knows of it in the steps shown.",
    "*iterations* are those of the worst of the three steps after the cut. *block Jacobi*: what is left if factors are "
    "not used until a new one comes. *plain*: the factor from before the cut. *corrected*: as it is done here "
    "([how](../preconditioners.md#when-elements-are-removed)). *new factor*: of the very matrix, made in the step. "
    "*ms*: the longest solve of these steps, on a GPU.",
)
LAG, SHARE = 10, 0.01  # steps; part of the elements a second
CARVED = (
    "1 % of the elements a second of simulation are removed, in each step as many as are due, from the upper edge of "
    f"the free end on; lockstep-{LAG}: factors are {LAG} to {2 * LAG - 1} steps old. Time of a step: changes of "
    "arrays, assembly, solve and integration, of the second half of each run; *whole*: the same scene in which nothing "
    "is cut, side by side. What a cut costs outside of steps, in the service's thread, is not in it.",
)


SPLITS = {  # what of the beam is split off
    "into, a fifth": "Z > 2 and Y > 0.8", "into, half": "Z > 2 and Y > 0.5", "corner": "Z > 3.4 and Y > 0.5",
    "through": "Z > 2", "three times": "1.2 < Z < 2 or Z > 2.8",
}  # fmt: skip
SPLIT = (
    "The same with faces opened around a region of the beam, and no element removed "
    "([how](../preconditioners.md#when-an-object-is-split)). *plain*: as if copies of nodes had been there without "
    "elements when the factor was made.",
)


def made(cells: list[int], preconditioner: str, update: str, device: str = "cpu", spare: int = 0) -> Simulation:
    body: dict[str, Any] = SCENE["object"][0] | {"mesh": {"bar": cells, "size": [1, 1, 4], "split": "mirrored"}}  # type: ignore[index]
    if spare:
        body["effects"] = body["effects"] | {"cutting": {"spare": spare}}
    solver = {"preconditioner": preconditioner, "update": update, "max_iterations": 2000}
    return Simulation(Scene.model_validate(SCENE | {"object": [body], "solver": solver}), device)


def chosen(sim: Simulation, what: str) -> Any:
    """Numbers of the elements of a cut."""
    body = sim.world.bodies[0]
    if not what.isdigit():
        return np.flatnonzero(where.mask(what, body.centroids))
    if what == "1000":
        return np.random.default_rng(1).choice(len(body.mesh.tets), len(body.mesh.tets) // 3, replace=False)
    top = np.argsort(-body.centroids[:, 1] - 0.01 * body.centroids[:, 2])
    return top[: max(1, int(what))]


def worst(driver: Driver) -> tuple[int, float]:
    """Most iterations of the next steps, and the longest solve [ms]."""
    records = driver.advance(AFTER)
    return int(records["iterations"].max()), 1e3 * float(records["solve"].max())


def solves(times: dict[str, float], device: str) -> dict[str, float]:
    """Cells of the longest solves; on a GPU, where a step is short beside what the machine does with others."""
    return {f"{m}, ms": times[m] for m in TIMED} if device == "gpu" else {}


def iterations(cells: list[int], what: str, method: str, device: str) -> tuple[int, float, Any]:
    """What is worst of the steps after a cut, and the elements that it took."""
    update = "every-1" if method == "new factor" else f"lockstep-{AGE}"
    sim = made(cells, "block_jacobi" if method == "block Jacobi" else "cholesky", update, device)
    driver = Driver(sim)
    driver.advance(BEFORE)
    removed = chosen(sim, what)
    sim.parameters.set({"beam.cutting.removed": f'"{text_of(removed)}"'})
    return *worst(driver), removed


def after_a_cut(cells: list[int], device: str) -> list[dict[str, Any]]:
    """A row for each cut."""
    rows = []
    for name, what in CUTS.items():
        row, times = dict[str, Any](), dict[str, float]()
        for method in METHODS:
            kept = Cutting.cut_input
            try:
                if method == "plain old factor":
                    Cutting.cut_input = lambda *_: None  # type: ignore[method-assign, assignment, return-value]
                row[method], times[method], removed = iterations(cells, what, method, device)
            finally:
                Cutting.cut_input = kept  # type: ignore[method-assign]
        row = {"cut": name, "elements": len(removed)} | row | solves(times, device)
        rows.append(row)
        print(row, flush=True)
    return rows


def iterations_split(cells: list[int], what: str, method: str, device: str) -> tuple[int, float, int, int]:
    """What is worst of the steps after a split, faces that it opened, and nodes that it copied."""
    update = "every-1" if method == "new factor" else f"lockstep-{AGE}"
    sim = made(cells, "block_jacobi" if method == "block Jacobi" else "cholesky", update, device, spare=300)
    assert sim.world.splitting is not None
    driver, splitter = Driver(sim), sim.world.splitting.splitters[0]
    driver.advance(BEFORE)
    faces = border(where.mask(what, sim.world.bodies[0].centroids), splitter.faces.owners)
    sim.parameters.set(opening(splitter, "", faces))
    copied = sim.world.splitting.of(sim.parameters.scene, 0).used
    return *worst(driver), len(faces), copied


def after_a_split(cells: list[int], device: str) -> list[dict[str, Any]]:
    """A row for each split."""
    rows = []
    for name, what in SPLITS.items():
        row, times = dict[str, Any](split=name, faces=0, copies=0), dict[str, float]()
        for method in METHODS:
            if device == "gpu" and method == "plain old factor":
                continue  # a GPU has no such way
            with without_correction() if method == "plain old factor" else nullcontext():
                row[method], times[method], row["faces"], row["copies"] = iterations_split(cells, what, method, device)
        row |= solves(times, device)
        rows.append(row)
        print(row, flush=True)
    return rows


SPLIT_ON_A_GPU = (
    "Factors from before a split are not used there: *corrected* is block Jacobi until a factor of the new pattern "
    "comes.",
)


@contextmanager
def without_correction() -> Iterator[None]:
    """Factors from before a split are used as they are."""
    kept = Cutting.cut_input
    Cutting.cut_input = lambda *given: replace(kept(*given), bodies=[])  # type: ignore[method-assign]
    try:
        yield
    finally:
        Cutting.cut_input = kept  # type: ignore[method-assign]


def course(cells: list[int], steps: int, cut: bool, device: str) -> tuple[Any, Any, int]:
    """Returns time of each step [ms], its iterations, and how many elements were removed at the end."""
    sim = made(cells, "cholesky", f"lockstep-{LAG}", device)
    driver, body, records = Driver(sim), sim.world.bodies[0], []
    order = np.argsort(-body.centroids[:, 2] - 0.2 * body.centroids[:, 1])
    each = SHARE * len(order) * 0.02
    removed = 0
    for step in range(steps):
        wanted = round(each * step)
        if cut and wanted > removed:
            removed = wanted
            sim.parameters.set({"beam.cutting.removed": f'"{text_of(order[:removed])}"'})
        records.append(driver.advance(1)[0])
    seconds = np.array([r["assemble"] + r["solve"] + r["integrate"] for r in records])
    return 1e3 * seconds[steps // 2 :], np.array([r["iterations"] for r in records])[steps // 2 :], removed


def while_cutting(sizes: list[list[int]], steps: int, rounds: int, device: str) -> list[dict[str, Any]]:
    """A row for each size: times of steps while elements are removed, and while none is."""
    rows = []
    for cells in sizes:
        found: dict[str, list[Any]] = {"cut": [], "whole": []}
        removed = 0
        for _ in range(rounds):
            for kind, runs in found.items():
                times, iterated, taken = course(cells, steps, kind == "cut", device)
                runs.append((times, iterated))
                removed = max(removed, taken)
        row: dict[str, Any] = {"tets": 6 * cells[0] * cells[1] * cells[2], "removed": removed}
        for kind, runs in found.items():
            for name, q in (("p50", 50), ("p99", 99)):
                row[f"{kind}, {name} ms"] = statistics.median(float(np.percentile(t, q)) for t, _ in runs)
            row[f"{kind}, iterations"] = statistics.median(float(i.mean()) for _, i in runs)
        row["p99 while cut over p50"] = row["cut, p99 ms"] / row["cut, p50 ms"]
        rows.append(row)
        print(row, flush=True)
    return rows


def picture(rows: list[dict[str, Any]]) -> Any:
    plt = plots()
    figure, axis = plt.subplots(figsize=(8, 4), layout="constrained")
    for k, method in enumerate(METHODS):
        axis.bar(np.arange(len(rows)) + 0.2 * k, [row[method] for row in rows], 0.2, label=method)
    axis.set_yscale("log")
    axis.set_xticks(np.arange(len(rows)) + 0.3, [row["cut"] for row in rows])
    axis.set(ylabel="iterations of the worst step after the cut")
    axis.legend()
    return figure


def main(
    steps: Annotated[int, typer.Option(min=4, help="Of each run")] = 400,
    rounds: Annotated[int, typer.Option(min=1)] = 3,
    device: Annotated[str, typer.Option(help="cpu, gpu or both")] = "cpu",
    quick: Annotated[bool, typer.Option("--quick", help="A small smoke run")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/cutting]")] = None,
) -> None:
    """Iterations after cuts, and times of steps while a body is cut."""
    sizes = [[2, 2, 6]] if quick else [[5, 5, 20], [10, 10, 40]]
    if quick:
        steps, rounds = 40, 1
    report = Report("cutting", "Cuts", {"steps": steps, "rounds": rounds, "device": device}, out, quick)
    small = [3, 3, 8] if quick else [5, 5, 20]
    report.say(*EXPLAINED)
    for on in ("cpu", "gpu") if device == "both" else (device,):
        beside = ", on a GPU" if on == "gpu" else ""
        rows = after_a_cut(small, on)
        report.say(f"## Iterations after a cut{beside}")
        report.table(rows)
        if on == "cpu":
            report.figure(picture(rows), "cutting.png", "Iterations of the worst step after a cut.")
            report.remember(rows, ("cut",), METHODS)
        splits = after_a_split(small, on)
        report.say(f"## Iterations after a split{beside}", *(SPLIT if on == "cpu" else SPLIT_ON_A_GPU))
        report.table(splits)
        carving = while_cutting(sizes, steps, rounds, on)
        report.say(f"## Steps while a body is cut{beside}", *CARVED)
        report.table(carving)
        report.data |= {f"{on} iterations": rows, f"{on} splits": splits, f"{on} steps": carving}
    report.write()


if __name__ == "__main__":
    typer.run(main)
