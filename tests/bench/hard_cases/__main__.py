# SPDX-License-Identifier: MIT
"""Runs the tables of hard cases (tests/hard_cases/table.py, models.py) and writes what was measured."""

import tempfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from tests.bench.harness.report import Report, plots
from tests.hard_cases.case import Case
from tests.hard_cases.models import MODEL_CASES, MODELS, QUICK, SITUATIONS
from tests.hard_cases.running import Outcome, broken, finer, run_case, unexpected
from tests.hard_cases.seeds import SEEDED, SPLITS, tally
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


def notes(cases: list[Case]) -> str:
    """Each note once, with the cases that it is about."""
    about: dict[str, list[str]] = {}
    for case in cases:
        if case.note:
            about.setdefault(case.note, []).append(case.name)
    return "\n".join(f"- *{', '.join(names)}*: {note}" for note, names in about.items())


def random_starts(quick: bool) -> list[dict[str, Any]]:
    """A row for each law and split of the cells."""
    seeds = range(1 if quick else 16)
    rows = []
    with np.errstate(all="ignore"):
        for name in list(SEEDED)[3:4] if quick else SEEDED:
            for split in SPLITS:
                rows.append({"law": name, "split": split, **tally(name, split, seeds)})
                print(rows[-1], flush=True)
    return rows


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


def main(
    quick: Annotated[bool, typer.Option("--quick", help="A smoke run of a few cases")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/hard_cases]")] = None,
) -> None:
    """Hard cases: what must hold, and what was measured."""
    cases, models = (CASES[::12], QUICK[::9]) if quick else (CASES, MODEL_CASES)
    report = Report("hard_cases", "Hard cases", {"cases": len(cases), "of models": len(models)}, out, quick)
    results, rises = measured(cases)
    rows = [row(case, outcome, rise) for (case, outcome), rise in zip(results, rises, strict=True)]
    report.say(ABOUT)
    report.table(rows)
    report.say("### Notes", notes(cases))
    report.figure(picture(results), "hard_cases.png", "Iterations of each case.")
    of_models, rises = measured(models)
    model_rows = [model_row(case, outcome, rise) for (case, outcome), rise in zip(of_models, rises, strict=True)]
    report.say(MODELS_ABOUT)
    report.table([{"situation": name, "what is done": done} for name, (done, _) in SITUATIONS.items()])
    report.say("*yes*: all of what must hold; *rises*: all of it, where the energy may rise; *refused*: by its name.")
    report.table(matrix(of_models))
    report.say("### Each case")
    report.table(model_rows)
    report.say("### Notes on models", notes(models))
    seeded = random_starts(quick)
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


def measured(cases: list[Case]) -> tuple[list[tuple[Case, Outcome]], list[float | None]]:
    """Each case, and its rise of energy with a tenth of the time step where the energy may rise."""
    results: list[tuple[Case, Outcome]] = []
    rises: list[float | None] = []
    with tempfile.TemporaryDirectory() as folder, np.errstate(all="ignore"):
        for case in cases:
            results.append((case, run_case(case, Path(folder))))
            rising = case.energy > 1e-6 and not case.fails
            rises.append(run_case(finer(case), Path(folder)).rise if rising else None)
            print(f"{case.name}: {'; '.join(broken(*results[-1])) or 'holds'}", flush=True)
    return results, rises


if __name__ == "__main__":
    typer.run(main)
