# SPDX-License-Identifier: MIT
"""Tables 1, 2 and 5 and figure 4 of Courtecuisse et al. 2010, measured here, each beside the paper's own figures."""

from pathlib import Path
from typing import Annotated

import typer

from tests.bench import _paper_words as words
from tests.bench import figure4
from tests.bench._paper_beam import BANDS, LOADS
from tests.bench._paper_tables import Setting, extrapolations, policies, recycled, table1, table2, table5
from tests.bench._schemes import SCENES, run
from tests.bench.report import Report


def section(setting: Setting, device: str, report: Report) -> None:
    """All tables of one device."""
    name = device.upper()
    one, two, five = table1(setting, device), table2(setting, device), table5(setting, device)
    policy = policies(setting, device)
    report.data[device] = {"table1": one, "table2": two, "table5": five, "policies": policy}
    report.say(
        f"## Table 1: sizes, {name}", f"Corotational, *{LOADS[1].name}*, async + warp, E of the beam of table 2."
    )
    report.table(one, words.COLUMNS1)
    report.say(
        "*latency* is the paper's steps to factorize, rounded up; *own latency* what a factorization takes here in "
        "steps of this machine, one thread each."
    )
    calibrations = {row["model"]: f"{row['model']} {row['stiffness']:.5g} ({row['condition']:.1f})" for row in two}
    report.say(
        f"## Table 2: loads, models and schemes, {name}",
        words.loads(),
        f"Stiffness and the condition number that it gives: {', '.join(calibrations.values())}. In each cell: "
        "iterations and ms per step, in brackets the paper's.",
    )
    report.table(words.shown2(two))
    report.say(words.verdict2(two))
    bands = " : ".join(f"{share:g}" for _, share in BANDS)
    report.say(
        f"## Table 5: preconditioners on the heterogeneous beam, {name}",
        f"E in three bands {bands}, stiffest at the held end ({five[0]['stiffness']:.5g} Pa there), condition number "
        f"{five[0]['condition']:.0f}; *{LOADS[1].name}*. *invert*: what a step waits for.",
    )
    report.table(five, words.COLUMNS5)
    report.say(words.verdict5(five))
    report.say(f"## Update policies, {name}", words.POLICIES.format(load=LOADS[2].name, latency=setting.latency))
    report.table(policy, words.COLUMNS_OF_POLICIES)
    if ahead := extrapolations(setting, device):
        report.data[device]["extrapolations"] = ahead
        told = words.EXTRAPOLATIONS.format(load=LOADS[2].name, steps=setting.steps)
        report.say(f"## Extrapolated states, {name}", told)
        report.table(ahead)
    if again := recycled(setting, device):
        report.data[device]["recycled"] = again
        report.say(f"## Recycled directions, {name}", words.RECYCLING.format(load=LOADS[2].name))
        report.table(again, words.COLUMNS_OF_RECYCLED)
    tables = (one, two, five, policy, again)
    bad = sum(row["unconverged"] for rows in tables for row in rows)
    alike = all(row["repeats"] for rows in tables for row in rows)
    report.say(
        f"Solves that did not reach the tolerance: {bad}. Iterations of all rounds alike, step by step: "
        f"{'yes' if alike else 'NO'}."
    )


def figure(report: Report, setting: Setting, latency: int, steps: int) -> None:
    """Figure 4, without processes: the page of figure4 has those too."""
    more = ("solver.factor_precision=float32", *(("object.beam.mesh.bar=[2, 2, 6]",) if setting.quick else ()))
    results = {
        kind.name: [run(SCENES / "beam.toml", kind, steps, more)] for kind in figure4.schemes(latency, processes=False)
    }
    rows = [figure4.row(name, runs, latency) for name, runs in results.items()]
    report.say("## Figure 4: schemes step by step", "Of deploy/scenes/beam.toml; more of it: figure4.md. On the CPU.")
    report.figure(figure4.pictures(results, latency), "paper.png", "Iterations and time of each step.")
    report.table(rows, ("scheme", "iterations, mean", "iterations, max", "step p50 [ms]", "step max [ms]"))
    report.say(figure4.order(rows, latency))


def devices(wanted: str) -> list[str]:
    """auto: the CPU and, where there is one, the GPU."""
    if wanted in ("cpu", "gpu"):
        return [wanted]
    from sim_server.cli import chosen

    return ["cpu"] if chosen("auto", print) == "cpu" else ["cpu", "gpu"]


def main(
    steps: Annotated[int, typer.Option(min=2, help="Steps of each run")] = 150,
    rounds: Annotated[int, typer.Option(min=1, help="Repetitions, the schemes taking turns")] = 3,
    latency: Annotated[int, typer.Option(min=1, help="Steps from a matrix to its factor, tables 2 and 5")] = 3,
    tolerance: Annotated[float, typer.Option(help="Of the true residual")] = 1e-6,
    device: Annotated[str, typer.Option(help="cpu, gpu, or auto: both, as far as they are there")] = "auto",
    quick: Annotated[bool, typer.Option("--quick", help="A small smoke run")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/paper]")] = None,
) -> None:
    """The tables of the paper, measured here, beside its own figures."""
    if device not in ("auto", "cpu", "gpu"):
        raise typer.BadParameter(f"--device {device}: allowed are auto, cpu, gpu")
    setting = Setting(12, 2, latency, tolerance, True) if quick else Setting(steps, rounds, latency, tolerance, False)
    arguments = {"steps": setting.steps, "rounds": setting.rounds, "latency": latency, "tolerance": tolerance,
                 "device": device}  # fmt: skip
    report = Report("paper", "The tables of Courtecuisse et al. 2010", arguments, out, quick)
    report.say(*words.explained(setting))
    for name in devices(device):
        section(setting, name, report)
    figure(report, setting, *((4, 12) if quick else (30, 150)))
    report.write()


if __name__ == "__main__":
    typer.run(main)
