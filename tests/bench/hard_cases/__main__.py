# SPDX-License-Identifier: MIT
"""Runs the tables of hard cases (tests/hard_cases/table.py, models.py, effect_table.py) and writes what was measured.

On a GPU all precisions by one call: --device gpu --precision float64 --precision mixed --precision float32 --jobs 16.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from tests.bench.hard_cases.running import STARTS, Runs, of_precision
from tests.bench.harness.report import Report, plots
from tests.hard_cases.case import Case
from tests.hard_cases.effect_table import EFFECT_CASES
from tests.hard_cases.long_runs import LONG_RUNS
from tests.hard_cases.models import MODEL_CASES, MODELS, QUICK, SITUATIONS
from tests.hard_cases.of_effects import SEEDS, EffectCase, EffectOutcome
from tests.hard_cases.running import Outcome, broken, unexpected
from tests.hard_cases.table import CASES

ABOUT = """\
A bar of 1 x 1 x 4 m (648 tetrahedra, E = 1 MPa, Poisson's ratio 0.45, dt = 0.02 s, tolerance 1e-6, factor by
lockstep-10 with warp) is driven where no run should get by itself. Each line is a test (tests/hard_cases); this page is
made by the same code.

- *must hold*: what the test asserts. J is det F of an element, L the length of the bar.
- *energy*: largest rise of kinetic + potential energy - work of the loads over its lowest earlier value, as a part of
  what the run dissipates. It never rises but where a note says why; there, *at dt / 10* is the rise (as a part of the
  same) when the first 150 steps are made with a tenth of the time step.
- *status*: of the solves; *converged* means the true residual, in every step.
- *at the end / L*: distance there; where every step is compared, the largest. *smallest J*: after the first step.
- *back*: step from which every node stays within the distance that must hold; *J > 0*: step from which no element is
  inverted."""

COLUMNS = (
    "case", "must hold", "holds", "energy", "at dt / 10", "status", "iterations mean / max", "back", "at the end / L",
    "smallest J", "J > 0",
)  # fmt: skip


def row(case: Case, out: Outcome, finer_rise: float | None) -> dict[str, Any]:
    """Measured, beside what must hold. finer_rise: of the energy with a tenth of the time step [J]."""
    back = "–" if case.rests in ("spin", "same") else "never" if out.recovered is None else str(out.recovered)
    return {
        "case": f"**{case.name}**",
        "what is done": case.done,
        "must hold": case.must_hold(),
        "holds": "; ".join(broken(case, out)) or "yes",
        "energy": f"{max(out.energy, 0):.1e}" if out.energy > 1e-9 else "0",
        "at dt / 10": "–" if finer_rise is None else f"{finer_rise / out.dissipated:.1e}",
        "status": out.worst,
        "factor left": out.fallbacks,
        "iterations mean / max": f"{out.iterations.mean():.1f} / {out.iterations.max():.0f}",
        "back": back,
        "at the end / L": f"{out.distance:.0e}" if case.rests != "spin" else "–",
        "smallest J": f"{out.lowest:.2g}",
        "J > 0": "never" if out.upright is None else "always" if out.upright == 0 else str(out.upright),
    }


MODELS_ABOUT = """\
## The deformation models

A bar of 1 x 1 x 4 m (192 tetrahedra, constants of about E = 1 MPa and Poisson's ratio 0.45, the rest as above) of each
model, in situations that are hard for one or the other (tests/hard_cases/models.py; some of them are tests). *Newton*:
with `[integrator] linearizations = 20`, which makes several linearizations a step with a line search; all others make
one, the default. *clamp*: with `[solver] projection = "clamp"`, what fails so and holds by default. *patch*, *smoothed*
and *quadratic* are kinds of `elements`. What is known not to hold is stated as such and shown: **no**, what does not
hold, and why.
"""

SEEDS_ABOUT = """\
## Random starts

The bar of 648 tetrahedra, split in two ways, every free node anywhere in the bounding box: how many of {seeds} seeds
end how after 14 s (Rayleigh damping 1/s; tests/hard_cases/seeds.py). *back at rest*: within 0.001 L; *elsewhere,
J > 0*: no element inverted, but folded through itself (there is no contact), or still in motion; *flown apart*: not
finite or ten lengths away. What follows a comma is Poisson's ratio, 0.45 elsewhere, `[solver] projection`, or the kind
of elements, linear elsewhere. *corotational* stays inside out where that is an equilibrium: lambda sees the sum of the
stretches alone, which an element turned inside out may have, too (effects/corotational.py).
"""


def verdict(case: Case, out: Outcome) -> str:
    """In the table of models and situations."""
    if unexpected(case, out) or broken(case, out):
        return "**no**"
    return "refused" if case.refused else "rises" if case.energy > 1e-6 and out.energy > 1e-6 else "yes"


def matrix(results: list[tuple[Case, Outcome]]) -> list[dict[str, str]]:
    """Models against situations."""
    found = {case.name: verdict(case, out) for case, out in results}
    columns = list(dict.fromkeys(name.split(": ")[0] for name in found))
    models = [model for model in MODELS if any(name.endswith(f": {model}") for name in found)]
    return [{"model": m, **{c: found.get(f"{c}: {m}", "–") for c in columns}} for m in models]


def model_row(case: Case, out: Outcome, finer_rise: float | None) -> dict[str, Any]:
    """As row, what is done being told once."""
    if not case.refused:
        found = row(case, out, finer_rise)
    else:
        found = dict.fromkeys(COLUMNS, "–") | {"case": f"**{case.name}**", "must hold": case.must_hold()}
        found |= {
            "holds": "; ".join(broken(case, out)) or "yes",
            "status": out.worst,
            "smallest J": f"{out.lowest:.2g}",
        }
    wrong = broken(case, out)
    found["holds"] = f"**no**: {'; '.join(wrong)}" if wrong else "yes"
    return {name: found[name] for name in COLUMNS}


def notes(cases: Sequence[Case | EffectCase]) -> str:
    """Each note once, with the cases that it is about."""
    about: dict[str, list[str]] = {}
    for case in cases:
        if case.note:
            about.setdefault(case.note, []).append(case.name)
    return "\n".join(f"- *{', '.join(names)}*: {note}" for note, names in about.items())


def random_starts(runs: Runs, quick: bool) -> list[dict[str, Any]]:
    """A row for each law and split of the cells."""
    wanted = STARTS[6:8] if quick else STARTS
    return [row for _, row in runs.all([("starts", STARTS.index(start), 1 if quick else 16, "") for start in wanted])]


def picture(results: list[tuple[Case, Outcome]]) -> Any:
    """Mean and largest iterations of each case."""
    plt = plots()
    figure, axis = plt.subplots(figsize=(9, 0.28 * len(results) + 1.2), layout="constrained")
    place = np.arange(len(results))[::-1]
    mean = [out.iterations.mean() for _, out in results]
    most = [out.iterations.max() for _, out in results]
    axis.hlines(place, mean, most, color="0.7")
    axis.plot(mean, place, "o", label="mean")
    axis.plot(most, place, "|", label="largest")
    axis.set(xscale="log", xlabel="iterations of a step", yticks=place, yticklabels=[case.name for case, _ in results])
    axis.grid(True, axis="x", which="both", alpha=0.3)
    axis.legend()
    return figure


EFFECTS_ABOUT = """\
## Effects

Contact, cuts, materials that remember, loads and holders (tests/hard_cases/effect_table.py), each of {seeds} seeds:
numbers are finite, steps are solved or say how they ended, and the figure of *must hold* is at most what stands there.
*holds*: of how many seeds; *worst*: of them. *status*: of all steps of all objects.
"""
LONG_ABOUT = """\
## Long runs

A bar of four cells (tests/hard_cases/long_runs.py). *memory*: of the process, grown since a tenth of the run. *cost*:
processor time of a step in the last tenth over that in the second.
"""
PRECISION_ABOUT = """\
## On the device, by precision

Device {device}: how many of the cases hold, of one seed, and which do not. In mixed and single precision solves may end
at rounding (status max_iterations), positions are compared to 1e-3 of the length, and the energy may rise by rounding:
1e-5 of what is dissipated in mixed, 1e-3 in single precision. *left out*: for lack of time.
"""


def effect_row(case: EffectCase, found: list[EffectOutcome]) -> dict[str, Any]:
    """Measured of all seeds, beside what must hold."""
    holding, status = sum(not out.wrong for out in found), sum((out.status for out in found), Counter[str]())
    bad = {name: count for name, count in status.items() if name != "converged"}
    iterations = np.concatenate([out.iterations for out in found])
    wrong = sorted({each for out in found for each in out.wrong})
    return {
        "case": f"**{case.name}**", "what is done": case.done, "must hold": f"{case.must} {case.most:g}",
        "holds": f"{holding} of {len(found)}" + (f": {'; '.join(wrong)}" if wrong else ""),
        "worst": f"{max(out.value for out in found):.3g}",
        "status": ", ".join(f"{n} × {name}" for name, n in bad.items()) or "converged",
        "iterations mean / max": f"{iterations.mean():.1f} / {iterations.max():.0f}",
    }  # fmt: skip


def effects(report: Report, runs: Runs, quick: bool) -> None:
    """The table of effects."""
    cases, seeds = (EFFECT_CASES[5:8], 1) if quick else (EFFECT_CASES, SEEDS)
    jobs = [("effect", EFFECT_CASES.index(case), seed, "") for case in cases for seed in range(seeds)]
    found = runs.all(jobs)
    rows = []
    for case in cases:
        of_case = [out for job, out in found if EFFECT_CASES[job[1]] is case]
        rows += [effect_row(case, of_case)] if of_case else []
    report.say(EFFECTS_ABOUT.format(seeds=seeds))
    report.table(rows)
    report.say(notes(cases))
    report.data["effects"] = rows


def long_runs(report: Report, runs: Runs, quick: bool) -> None:
    """The table of long runs."""
    rows = []
    for job, out in runs.all([("long", k, int(quick), "") for k in range(1 if quick else len(LONG_RUNS))]):
        run = LONG_RUNS[job[1]]
        rows.append({
            "run": f"**{run.name}**", "what is done": run.done, "steps": 1000 if quick else run.steps,
            "must hold": f"{run.must} {run.most:g}", "holds": "; ".join(out.wrong(run)) or "yes",
            "drift": f"{out.drift:.1e}", "memory, MiB": f"{out.growth:.1f}", "cost": f"{out.cost:.2f}",
            "iterations": f"{out.iterations:.1f}",
        })  # fmt: skip
    report.say(LONG_ABOUT)
    report.table(rows)
    report.data["long"] = rows


def by_precision(report: Report, device: str, precisions: list[str], jobs: int, limit: float, quick: bool) -> None:
    """The cases, effects and models on a device, by precision."""
    rows = []
    cases = CASES[::12] if quick else CASES
    wanted = [("case", CASES.index(case), 0, p) for case in cases for p in precisions]
    wanted += [("effect", k, 0, p) for k in range(2 if quick else len(EFFECT_CASES)) for p in precisions]
    wanted += [("model", k, 0, p) for k in range(1 if quick else len(QUICK)) for p in precisions]
    found = Runs(jobs, device, limit).all(wanted)
    for precision in precisions:
        for kind, what in (("case", "cases"), ("effect", "effects"), ("model", "models")):
            all_jobs = [job for job in wanted if job[0] == kind and job[3] == precision]
            done = [(job, out) for job, out in found if job[0] == kind and job[3] == precision]
            wrong = {name: text for job, out in done for name, text in [verdict_of(job, out)] if text}
            rows.append({
                "precision": precision, "of": what, "hold": f"{len(done) - len(wrong)} of {len(done)}",
                "left out": len(all_jobs) - len(done),
                "do not": "<br>".join(f"*{name}*: {text}" for name, text in wrong.items()) or "–",
            })  # fmt: skip
    report.say(PRECISION_ABOUT.format(device=device))
    report.table(rows)
    report.data["precisions"] = rows


def verdict_of(job: tuple[str, int, int, str], out: Any) -> tuple[str, str]:
    """Name of a case, and what does not hold, or how the run ended."""
    kind, index = job[:2]
    name = {"case": CASES, "effect": EFFECT_CASES, "model": QUICK}[kind][index].name
    if isinstance(out, str):
        return name, out
    if kind == "effect":
        return name, "; ".join(out.wrong)
    case = of_precision((CASES if kind == "case" else QUICK)[index], job[3])
    return name, "; ".join(unexpected(case, out))


def main(
    quick: Annotated[bool, typer.Option("--quick", help="A smoke run of a few cases")] = False,
    device: Annotated[str, typer.Option(help="cpu, or gpu: then the table by precision alone")] = "cpu",
    precision: Annotated[list[str] | None, typer.Option(help="Of a GPU, one or more [default: float64]")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes")] = 1,
    limit: Annotated[float, typer.Option(min=0, help="Seconds after which cases of a GPU are left out, 0: never")] = 0,
    long: Annotated[bool, typer.Option("--long", help="Long runs, too: up to a million steps")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/hard_cases]")] = None,
) -> None:
    """Hard cases: what must hold, and what was measured."""
    if device == "gpu" or precision:
        told = {"device": device, "precision": " ".join(precision or ["float64"])}
        report = Report("hard_cases", "Hard cases", told, out, quick)
        by_precision(report, device, precision or ["float64"], jobs, limit, quick)
        report.write()
        return
    cases, models = (CASES[::12], QUICK[::9]) if quick else (CASES, MODEL_CASES)
    counts = {"cases": len(cases), "of models": len(models), "of effects": len(EFFECT_CASES)}
    report = Report("hard_cases", "Hard cases", counts, out, quick)
    runs = Runs(jobs)
    results, rises = measured(cases, runs)
    rows = [row(case, outcome, rise) for (case, outcome), rise in zip(results, rises, strict=True)]
    report.say(ABOUT)
    report.table(rows)
    report.say("### Notes", notes(cases))
    report.figure(picture(results), "hard_cases.png", "Iterations of each case.")
    effects(report, runs, quick)
    if long or quick:
        long_runs(report, runs, quick)
    of_models, rises = measured(models, runs)
    model_rows = [model_row(case, outcome, rise) for (case, outcome), rise in zip(of_models, rises, strict=True)]
    tell_models(report, of_models, model_rows, models)
    seeded = random_starts(runs, quick)
    report.say(SEEDS_ABOUT.format(seeds=1 if quick else 16))
    report.table(seeded)
    report.data["rows"], report.data["models"], report.data["seeds"] = rows, model_rows, seeded
    both = results + of_models
    total = {"cases": len(both), "that do not hold": sum(bool(broken(*pair)) for pair in both),
             "iterations of a step": float(np.mean([out.iterations.mean() for _, out in both]))}  # fmt: skip
    report.remember([total], (), tuple(total))
    report.data["iterations"] = {case.name: outcome.iterations for case, outcome in both}
    report.write()
    if any(unexpected(case, outcome) for case, outcome in both):
        raise typer.Exit(1)


def tell_models(
    report: Report, found: list[tuple[Case, Outcome]], rows: list[dict[str, Any]], cases: list[Case]
) -> None:
    """The tables of models."""
    report.say(MODELS_ABOUT)
    report.table([{"situation": name, "what is done": done} for name, (done, _) in SITUATIONS.items()])
    report.say("*yes*: all of what must hold; *rises*: all of it, where the energy may rise; *refused*: by its name.")
    report.table(matrix(found))
    report.say("### Each case")
    report.table(rows)
    report.say("### Notes on models", notes(cases))


def measured(cases: list[Case], runs: Runs) -> tuple[list[tuple[Case, Outcome]], list[float | None]]:
    """Each case, and its rise of energy with a tenth of the time step where the energy may rise."""
    found = dict(runs.of_cases(cases, finer_too=lambda case: case.energy > 1e-6 and not case.fails))
    results = [(case, found[index, False]) for index, case in enumerate(cases)]
    return results, [found[index, True].rise if (index, True) in found else None for index in range(len(cases))]


if __name__ == "__main__":
    typer.run(main)
