# SPDX-License-Identifier: MIT
"""Whose matrix is factorized next: the rules of the scheduler where a few objects are dragged about and most rest."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Job
from tests.bench.harness.pieces import Merged, Piece
from tests.bench.harness.report import Report, plots
from tests.bench.scheduler.few_wild import APART, Load, is_wild, scene
from tests.support.virtual_workers import VirtualWorkers

RULES = ("round_robin", "excess")
MANY = 32  # nodes of all hands of an object that its factor is corrected for
CORRECTED = ", grabs corrected"  # solver.woodbury, as by default
ORACLE, NEVER, EACH = "oracle", "no updates", "a worker for each object"
COLUMNS = ("objects", "wild", "workers", "rule", "iterations", "/ round robin", "/ oracle", "/ no updates",
           "wild, mean", "rest, mean", "p50", "p99", "age, mean", "age, max", "age, bound", "factors")  # fmt: skip


@dataclass(frozen=True)
class Setting:
    """What all runs have in common."""

    steps: int
    hold: int  # steps
    warm: int  # steps before those that count
    speed: float  # operations of a factorization that a worker does in a step
    floor: int  # iterations
    seed: int


def run(objects: int, workers: int, name: str, setting: Setting, **solver: Any) -> dict[str, Any]:
    """One run; everybody begins with the factor of the first matrix. Returns its row, without ratios."""
    sim = Simulation(scene(objects, **{"update_floor_iterations": setting.floor, "woodbury": 0, **solver}))
    load = Load(sim, setting.hold, setting.seed)
    driver = Driver(sim, VirtualWorkers(sim, workers, setting.speed), counted=True)
    _first_factors(driver)
    records = []
    for step in range(setting.warm + setting.steps):
        if step == setting.warm:
            before = sum(t.factors.used for t in driver.bodies)
        load.act()
        records.append(driver.advance(1))
    r = np.concatenate(records[setting.warm :]).reshape(setting.steps, objects)
    assert (r["status"] == 0).all(), "a solve did not converge"
    bound = driver.age_bound()
    made = sum(t.factors.used for t in driver.bodies) - before
    wild = np.array([is_wild(k) for k in range(objects)])
    return {"objects": objects, "wild": int(wild.sum()), "workers": workers, "rule": name,
            **_figures(r["iterations"].astype(int), r["step"] - 1 - r["factor_step"], wild),
            "age, bound": bound if bound >= 0 else None, "factors": made}  # fmt: skip


def _first_factors(driver: Driver) -> None:
    system = driver.simulation.system
    driver.engine.assemble()
    for body in driver.simulation.world.bodies:
        driver.inline.submit(Job(body.name, 1, 0, True, system.body_values(body.first, body.last)))
    for factor in driver.inline.poll():
        driver.adopt([factor])


def _figures(iterations: NDArray[Any], age: NDArray[Any], wild: NDArray[np.bool_]) -> dict[str, Any]:
    """Both (steps, objects)."""
    return {
        "iterations": int(iterations.sum()),
        "wild, mean": float(iterations[:, wild].mean()),
        "rest, mean": float(iterations[:, ~wild].mean()),
        "p50": float(np.percentile(iterations, 50)),
        "p99": float(np.percentile(iterations, 99)),
        "age, mean": float(age.mean()),
        "age, max": int(age.max()),
    }


def compared(objects: int, workers: list[int], setting: Setting) -> list[dict[str, Any]]:
    """The rows of one number of objects, with ratios."""
    rows = [
        run(objects, 0, ORACLE, setting, update="every-1"),
        run(objects, 0, NEVER, setting, update="never"),
        run(objects, objects, EACH, setting),
    ]
    for count in workers:
        rows += [run(objects, count, rule, setting, schedule=rule) for rule in RULES]
        rows.append(run(objects, count, "excess, default floor", setting, update_floor_iterations=3))
        for rule in ("round_robin", "excess"):
            rows.append(run(objects, count, rule + CORRECTED, setting, schedule=rule, woodbury=MANY))
    total = {(row["rule"], row["workers"]): row["iterations"] for row in rows}
    for row in rows:
        row["/ oracle"] = row["iterations"] / total[ORACLE, 0]
        row["/ no updates"] = row["iterations"] / total[NEVER, 0]
        other = "round_robin" + CORRECTED * row["rule"].endswith(CORRECTED)
        if (turns := total.get((other, row["workers"]))) is not None:
            row["/ round robin"] = row["iterations"] / turns
    return rows


def picture(rows: list[dict[str, Any]], sizes: list[int], workers: list[int]) -> Any:
    """(a) iterations over the oracle's and (b) oldest factor, against the number of objects, by workers."""
    plt = plots()
    figure, axes = plt.subplots(2, len(workers), figsize=(4 * len(workers), 8), sharex=True, sharey="row",
                                layout="constrained", squeeze=False)  # fmt: skip
    for column, count in enumerate(workers):
        for name in (NEVER, *RULES, EACH):
            own = [r for r in rows if r["rule"] == name and (r["workers"] == count or name in (NEVER, EACH))]
            style = {NEVER: ":", EACH: ":"}.get(name, "-")
            along = [r["objects"] for r in own]
            axes[0, column].plot(along, [r["/ oracle"] for r in own], style, marker="o", ms=3, label=name)
            if name in RULES:
                axes[1, column].plot(
                    along, [r["age, max"] for r in own], style, marker="o", ms=3, color=f"C{1 + RULES.index(name)}"
                )
        axes[0, column].axhline(1.3, color="0.6", lw=0.8)
        axes[0, column].set(title=f"{count} worker{'s' * (count > 1)}", xscale="log", xticks=sizes, xticklabels=sizes)
        axes[1, column].set(xlabel="objects", yscale="log")
    axes[0, 0].set_ylabel("(a) iterations, of the oracle's (grey: 1.3)")
    axes[1, 0].set_ylabel("(b) oldest factor [steps]")
    for axis in axes.flat:
        axis.grid(True, alpha=0.3)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=6, fontsize="small")
    return figure


def _explained(setting: Setting) -> tuple[str, ...]:
    return (
        f"""\
Beams of 96, 216 and 324 tetrahedra in turn, E 0.1 MPa, some a hundred times stiffer beyond their first third, held at
one end, dt = 20 ms, tolerance 1e-6 of the true residual, warped float32 Cholesky factors. One in {APART} is *wild*: a
stiff hand (1e7 N/m on all nodes within 0.8 m) takes hold somewhere, drags it about a metre away, lets go after
{setting.hold} steps and takes hold elsewhere; the others tremble. Everybody begins with a factor of the first matrix;
{setting.steps} steps count, from seed {setting.seed}, after {setting.warm} in which the hands, which all take hold in
the first step, come out of step with one another.""",
        f"""\
Workers are virtual: one takes as many steps for a factor as its operations need at {setting.speed:.3g} a step (1, 2 and
3 steps for the three sizes), one matrix at a time; a matrix is copied in the step after its worker became idle. So
a factor is 2 steps old at best when it is taken up, and the counts below repeat to the digit. *oracle*: a factor of
each step's own matrix for every object; *no updates*: the first factor only; *{EACH}*: what asynchrony
alone costs, with hardly anybody to share with. Ratios are of the iterations of all objects and steps;
the resting ones, alike under every rule, draw them towards 1. Ages are of the factors used [steps].""",
        f"""\
The floor of iterations is {setting.floor} here (default 3): a fresh float32 factor needs 1 or 2, so that what exceeds 2
is what a new factor would save; with 3 an object dragged slowly looks satisfied at 3 iterations and turns go to those
at rest. The rows *default floor* have 3.""",
        f"""\
Factors are not corrected for the hands' springs (woodbury = 0): so the rules have something to do. The rows
*grabs corrected* have woodbury = {MANY}: springs that a factor does not know cost little then, under any rule.""",
    )


WHY = """\
Aims: *excess* at most 0.7 of round robin's iterations and at most 1.3 of the oracle's. Where a worker for each object
misses an aim too, no rule can meet it: asynchrony itself stands in the way (a factor at least 2 steps old against a
fresh one each step), the workers are too few, or round robin's turns are short already. The best order of jobs, told
beforehand when and where hands take hold, was searched for once and hardly beats a worker for each object. The rest is
foresight: until its next factor an object solves against a spring that its factor does not know; a rule learns of it
when iterations rise, and then a worker may be busy. Where round robin needs more than no updates, its factors hold
springs that are gone besides lacking those that are there; the first factor holds none."""


def _numbers(text: str) -> list[int]:
    try:
        found = [int(word) for word in text.split(",")]
    except ValueError:
        raise typer.BadParameter(f"{text!r}: whole numbers with commas between, as 4,16") from None
    if min(found) < 1:
        raise typer.BadParameter(f"{text!r}: numbers must be at least 1")
    return found


def main(
    objects: Annotated[str, typer.Option(help="Numbers of objects")] = "4,16,64,256",
    workers: Annotated[str, typer.Option(help="Numbers of workers")] = "1,2,4",
    steps: Annotated[int, typer.Option(min=2, help="Steps that count of each run")] = 200,
    hold: Annotated[int, typer.Option(min=2, help="Steps for which a hand holds")] = 60,
    speed: Annotated[
        float, typer.Option(min=1, help="Operations of a factorization that a worker does in a step")
    ] = 3e5,
    floor: Annotated[int, typer.Option(min=0, help="Iterations above which there is excess")] = 2,
    seed: Annotated[int, typer.Option(help="Of where the hands take hold")] = 0,
    quick: Annotated[bool, typer.Option("--quick", help="A small smoke run")] = False,
    merge: Annotated[
        list[Path] | None, typer.Option(metavar="JSON", help="Only make one page of these results; may be repeated")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/scheduler]")] = None,
) -> None:
    """Iterations and ages of factors under each rule, beside an oracle and no updates, in virtual time."""
    sizes, counts = _numbers("4,16" if quick else objects), _numbers("1,2" if quick else workers)
    hold = 10 if quick else hold
    setting = Setting(30 if quick else steps, hold, hold, speed, floor, seed)
    title = "Whose matrix is factorized next: the rules compared"
    if merge:
        merged = Merged("scheduler", title, merge, out)
        told = merged.parts[-1]["arguments"]
        rows = sorted(merged.rows("rows", ("objects", "workers", "rule")), key=lambda row: row["objects"])
        write(merged, rows, Setting(**{field.name: told[field.name] for field in fields(Setting)}))
        return
    report = Piece("scheduler", title, {"objects": sizes, "workers": counts, **vars(setting)}, out, quick)
    rows = []
    for size in sizes:
        rows += compared(size, counts, setting)
        report.data["rows"] = rows
        report.keep()
        print(f"{size} objects done", flush=True)
    write(report, rows, setting)


def write(report: Report, rows: list[dict[str, Any]], setting: Setting) -> None:
    """Page, picture and JSON."""
    sizes = sorted({row["objects"] for row in rows})
    counts = sorted({row["workers"] for row in rows if row["rule"] in RULES})
    report.say(*_explained(setting))
    report.figure(picture(rows, sizes, counts), "scheduler.png", "Iterations and the oldest factor under each rule.")
    report.say(WHY)
    report.remember([r for r in rows if r["rule"] == "excess"], ("objects", "workers"), ("iterations", "age, max"))
    report.table([{**row, "workers": row["workers"] or None} for row in rows], COLUMNS)
    report.data["rows"] = rows
    report.write()


if __name__ == "__main__":
    typer.run(main)
