# SPDX-License-Identifier: MIT
"""The page of hard cases, of what one or several runs of the bench found (rows of measuring.py)."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench.hard_cases import texts
from tests.bench.hard_cases.measuring import TABLES, Row, counts, status_of
from tests.bench.harness.report import Report, plots
from tests.hard_cases.case import Case
from tests.hard_cases.long_runs import LONG_RUNS
from tests.hard_cases.models import MODELS, SITUATIONS
from tests.hard_cases.recipes import RECIPES, recipe_of
from tests.hard_cases.seeds import ENDS

PLACES = (("cpu", "float64"), ("gpu", "float64"), ("gpu", "mixed"), ("gpu", "float32"))


class Given(Report):
    """A report whose head is that of a run made before."""

    def __init__(self, given: Row, pieces: int, out: Path | None, quick: bool):
        super().__init__("hard_cases", "Hard cases", {"pieces": pieces}, out, quick=True)  # a short calibration
        self.given, self.quick = given, quick

    def header(self) -> Row:
        return self.given


class Found:
    """Rows of all parts, the latest of each job."""

    def __init__(self, parts: Sequence[Row]):
        latest: dict[tuple[Any, ...], Row] = {}
        for part in parts:
            for row in part["rows"]:
                latest[tuple(row[k] for k in ("kind", "name", "seed", "device", "precision", "finer"))] = row
        self._rows = list(latest.values())
        self.places = [p for p in PLACES if any((r["device"], r["precision"]) == p for r in self._rows)]

    def of(self, kind: str, name: str = "", place: tuple[str, str] | None = None, finer: bool = False) -> list[Row]:
        """Of a case, or of all of a kind, at one place or all."""
        return [
            r for r in self._rows if r["kind"] == kind and r["finer"] == finer and name in ("", r["name"])
            and place in (None, (r["device"], r["precision"]))
        ]  # fmt: skip

    def names(self, kind: str) -> list[str]:
        """Of a table, in its order, of which there are rows."""
        there = {row["name"] for row in self.of(kind)}
        return [name for name in TABLES[kind] if name in there]

    def told(self, kind: str, name: str) -> dict[str, str]:
        """n of m by place, the columns of all tables."""
        return {_place(place): counts(self.of(kind, name, place)) for place in self.places}

    def best(self, kind: str, name: str) -> list[Row]:
        """Of the first place that has it."""
        return next(rows for place in self.places if (rows := self.of(kind, name, place)))


def _place(place: tuple[str, str]) -> str:
    return place[0].upper() if place[1] == "float64" else f"{place[0].upper()}, {place[1]}"


def _worst(rows: Iterable[Row], key: str, pick: Any = max) -> float | None:
    """The largest (smallest) value that is a number; a pair's last (first)."""
    values = [row[key] for row in rows if row.get(key) is not None]
    values = [v[-1] if pick is max else v[0] for v in values if isinstance(v, list)] or values
    return pick(values) if values else None


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def _volume(rows: list[Row]) -> str:
    low, high = _worst(rows, "volume", min), _worst(rows, "volume")
    return "–" if low is None or high is None else f"{low:.2g} to {high:.2g}"


def _solves(rows: list[Row]) -> Row:
    iterations = [row["iterations"] for row in rows if row.get("iterations") is not None]
    mean = float(np.mean(iterations)) if iterations else None
    return {
        "status": status_of(rows), "residual": _number(_worst(rows, "residual"), ".0e"),
        "iterations mean / max": f"{_number(mean, '.1f')} / {_number(_worst(rows, 'most_iterations'), '.0f')}",
        "cost": _cost(rows), "V / V0": _volume(rows), "smallest J": _number(_worst(rows, "lowest", min), ".2g"),
    }  # fmt: skip


def _cost(rows: list[Row]) -> str:
    """Of the seed that was run beside the scene made easy."""
    cost = next((row["cost"] for row in rows if row.get("cost")), None)
    return " / ".join(_number(part, ".1f") for part in cost) if cost else "–"


def case_row(case: Case, found: Found, kind: str) -> Row:
    """What was measured, the worst of all seeds, beside what must hold."""
    rows, finer = found.best(kind, case.name), found.of(kind, case.name, finer=True)
    energy, back = _worst(rows, "energy"), [row.get("recovered") for row in rows]
    smaller = [row["rise"] / rows[0]["dissipated"] for row in finer if rows[0].get("dissipated")]
    row = {"case": f"**{case.name}**", "what is done": case.done, "must hold": case.must_hold()}
    row |= found.told(kind, case.name)
    row |= {"energy": "0" if energy is not None and energy <= 1e-9 else _number(energy, ".1e"),
            "at dt / 10": _number(smaller[0] if smaller else None, ".1e")} | _solves(rows)  # fmt: skip
    row["back"] = "–" if case.rests in ("spin", "same") else "never" if None in back else str(max(back))
    if case.several:
        home = [each["home"] for each in rows if each.get("home") is not None]
        row["back"] += f"; {sum(each <= case.within for each in home)} of {len(home)} straight"
    row["at the end / L"] = "–" if case.rests == "spin" else _number(_worst(rows, "distance"), ".0e")
    return row


def effect_row(name: str, found: Found) -> Row:
    case, rows = TABLES["effect"][name], found.best("effect", name)
    row = {"case": f"**{name}**", "what is done": case.done, "must hold": f"{case.must} {case.most:g}"}
    return row | found.told("effect", name) | {"worst": _number(_worst(rows, "value"), ".3g")} | _solves(rows)


def recipe_rows(found: Found) -> list[Row]:
    """n of m of each recipe, of all its cases and seeds; known failures of models count as what they are."""
    rows = []
    for number, recipe in enumerate(RECIPES, 1):
        kinds = [(k, n) for k in ("case", "effect", "model", "long") for n in found.names(k) if recipe_of(n) == number]
        row: Row = {"": number, "what": recipe.what, "known from": recipe.origin, "cases": len(kinds)}
        for place in found.places:
            row[_place(place)] = counts([r for kind, name in kinds for r in found.of(kind, name, place)])
        tests = ", ".join(f"`{each}`" for each in recipe.tests)
        rows.append(row | {"and": "[random starts](#random-starts)" if number == 1 else tests or "–"})
    return rows


def verdict(case: Case, rows: list[Row]) -> str:
    """In the table of models and situations."""
    if any(row["refused"] for row in rows):
        return "not there"
    if any(row["wrong"] for row in rows):
        return "**no**"
    energy = _worst(rows, "energy") or 0.0
    return "refused" if case.refused else "rises" if case.energy > 1e-6 and energy > 1e-6 else "yes"


def matrix(found: Found) -> list[dict[str, str]]:
    """Models against situations."""
    names = found.names("model")
    said = {name: verdict(TABLES["model"][name], found.best("model", name)) for name in names}
    columns = list(dict.fromkeys(name.split(": ")[0] for name in names))
    models = [model for model in MODELS if any(name.endswith(f": {model}") for name in names)]
    return [{"model": m, **{c: said.get(f"{c}: {m}", "–") for c in columns}} for m in models]


def notes(cases: Iterable[Any]) -> str:
    """Each note once, with the cases that it is about."""
    about: dict[str, list[str]] = {}
    for case in cases:
        if case.note:
            about.setdefault(case.note, []).append(case.name)
    return "\n".join(f"- *{'*, *'.join(names)}*: {note}" for note, names in about.items())


def failures(found: Found) -> list[Row]:
    """Everything that does not hold: where, how, and why."""
    rows = []
    for kind in ("case", "effect", "model", "long"):
        for name in found.names(kind):
            wrong: dict[str, list[str]] = {}
            for place in found.places:
                for row in found.of(kind, name, place):
                    if row["wrong"]:
                        wrong.setdefault(row["wrong"], []).append(f"{_place(place)}, seed {row['seed']}")
            case = TABLES[kind][name]
            for text, where in wrong.items():
                known = getattr(case, "fails", False) or getattr(case, "several", False)
                why = getattr(case, "note", "") or "–"
                row = {"case": f"**{name}**", "where": "; ".join(where), "what": text}
                rows.append(row | {"known": "yes" if known else "no", "why": why})
    return rows


def refusals(found: Found) -> list[Row]:
    """What a device refuses by its reason."""
    rows: dict[tuple[str, str], list[str]] = {}
    for kind in ("case", "effect", "model", "start"):
        for name in found.names(kind):
            for row in found.of(kind, name):
                if row["refused"]:
                    where = _place((row["device"], row["precision"]))
                    said = rows.setdefault((where, row["refused"]), [])
                    said += [name] if name not in said else []
    return [{"where": where, "cases": ", ".join(names), "reason": why} for (where, why), names in rows.items()]


def start_rows(found: Found) -> list[Row]:
    """Random starts: how many of the seeds end how, by place."""
    rows = []
    for place in found.places:
        for name in found.names("start"):
            of = found.of("start", name, place)
            if of:
                law, split = TABLES["start"][name]
                rows.append({"where": _place(place), "law": law, "split": split, "seeds": len(of)}
                            | {end: sum(r.get("end") == end for r in of) for end in ENDS})  # fmt: skip
    return rows


def times(parts: Sequence[Row]) -> list[Row]:
    """Wall time of each run, and the sum of its cases."""
    rows = []
    for part in parts:
        head, told = part["head"], part["told"]
        machine = head["machine"]
        where = machine["gpu"] if told["device"] == "gpu" else machine["cpu"]
        rows.append({
            "run": f"{told['only']}; {told['precision']}; {told['seeds']} seeds",
            "on": f"{where}, {machine['cores']} cores",
            "load": machine["load"], "processes": told["jobs"], "runs of cases": len(part["rows"]),
            "wall time, s": f"{part['seconds']:.0f}",
            "sum of the cases, s": f"{part['wall']:.0f}", "left out": len(part["left_out"]), "commit": head["commit"],
        })  # fmt: skip
    return rows


def iterations_picture(found: Found) -> Any:
    """Mean and largest iterations of each case."""
    plt, names = plots(), found.names("case")
    figure, axis = plt.subplots(figsize=(9, 0.28 * len(names) + 1.2), layout="constrained")
    place = np.arange(len(names))[::-1]
    rows = [found.best("case", name) for name in names]
    mean = [float(np.mean([row["iterations"] or 0 for row in each])) for each in rows]
    most = [_worst(each, "most_iterations") or 0 for each in rows]
    axis.hlines(place, mean, most, color="0.7")
    axis.plot(mean, place, "o", label="mean")
    axis.plot(most, place, "|", label="largest")
    axis.set(xscale="log", xlabel="iterations of a step", yticks=place, yticklabels=names)
    axis.grid(True, axis="x", which="both", alpha=0.3)
    axis.legend()
    return figure


def worst_picture(found: Found, count: int = 12) -> Any:
    """Distance from where it must come back to, over the run, of the cases and models that come back last, or never;
    without those that are stated to fail."""
    plt = plots()
    curves = []
    for kind in ("case", "model"):
        for name in found.names(kind):
            case = TABLES[kind][name]
            if case.rests in ("pose", "static", "still") and not case.fails:
                rows = [r for r in found.best(kind, name) if r.get("curve")]
                late = max((r["recovered"] or 10 * case.steps) / case.steps for r in rows) if rows else 0
                curves += [(late, name, case, rows)] if rows else []
    curves = sorted(curves, key=lambda each: -each[0])[:count]
    figure, axes = plt.subplots(-(-len(curves) // 3), 3, figsize=(11, 2.2 * -(-len(curves) // 3)), layout="constrained",
                                sharey=True, squeeze=False)  # fmt: skip
    for axis, (_, name, case, rows) in zip(axes.flat, curves, strict=False):
        for row in rows:
            axis.semilogy(np.linspace(1, case.steps, len(row["curve"])), np.maximum(row["curve"], 1e-12), lw=1)
        axis.axhline(case.within, color="0.6", lw=0.8)
        axis.set_title(name, fontsize=8)
        axis.grid(alpha=0.3)
    for axis in axes[:, 0]:
        axis.set_ylabel("distance / L")
    for axis in axes[-1]:
        axis.set_xlabel("step")
    for axis in axes.flat[len(curves) :]:
        axis.set_visible(False)
    return figure


def write_page(parts: list[Row], out: Path | None, quick: bool, report: Report | None = None,
               merged: Row | None = None) -> None:  # fmt: skip
    """hard_cases.md and .json of all parts; merged: content of the file whose head it gets."""
    found = Found(parts)
    if report is None:
        assert merged is not None
        report = Given(merged["header"], len(parts), out, quick)
    report.say(texts.ABOUT, texts.RECIPES)
    report.table(recipe_rows(found))
    report.say(texts.FAILURES)
    report.table(failures(found) or [{"case": "–"}])
    if said := refusals(found):
        report.say(texts.REFUSALS)
        report.table(said)
    report.say(texts.TIMES)
    report.table(times(parts))
    report.say(texts.EXTREMES)
    report.table(texts.EXTREME_ROWS)
    if found.names("case"):
        _tell_cases(report, found)
    if names := found.names("effect"):
        report.say(texts.EFFECTS)
        report.table([effect_row(name, found) for name in names])
        report.say(notes(TABLES["effect"][name] for name in names))
    if found.names("model"):
        _tell_models(report, found)
    if found.names("start"):
        report.say(texts.STARTS)
        report.table(start_rows(found))
    if found.names("long"):
        report.say(texts.LONG)
        report.table(long_rows(found))
        report.say(notes(run for run in LONG_RUNS if run.name in found.names("long")))
    report.data["parts"] = parts
    cases = [row for kind in ("case", "effect", "model") for row in found.of(kind, place=("cpu", "float64"))]
    if cases:
        total = {"cases": len(cases), "that do not hold": sum(bool(row["wrong"]) for row in cases)}
        report.remember([total], (), tuple(total))
    report.write()


def _tell_cases(report: Report, found: Found) -> None:
    names = found.names("case")
    report.say(texts.CASES)
    report.table([case_row(TABLES["case"][name], found, "case") for name in names])
    report.say("### Notes", notes(TABLES["case"][name] for name in names))
    report.figure(iterations_picture(found), "hard_cases.png", "Iterations of each case.")
    caption = (
        "The cases that come back last, or never, but for those that are stated to fail: distance from there, of all "
        "seeds; the line is what must hold."
    )
    report.figure(worst_picture(found), "hard_cases_worst.png", caption)


def _tell_models(report: Report, found: Found) -> None:
    names = found.names("model")
    report.say(texts.MODELS)
    report.table([{"situation": name, "what is done": done} for name, (done, _) in SITUATIONS.items()])
    report.say(texts.MATRIX)
    report.table(matrix(found))
    report.say("### Each case")
    rows = [case_row(TABLES["model"][name], found, "model") for name in names]
    report.table([{k: v for k, v in row.items() if k != "what is done"} for row in rows])
    report.say("### Notes on models", notes(TABLES["model"][name] for name in names))


def long_rows(found: Found) -> list[Row]:
    rows = []
    for name in found.names("long"):
        run, row = next(r for r in LONG_RUNS if r.name == name), found.best("long", name)[0]
        rows.append({
            "run": f"**{name}**", "what is done": run.done, "steps": row.get("steps"),
            "must hold": f"{run.must} {run.most:g}", "holds": row["wrong"] or "yes",
            "drift": _number(row.get("drift"), ".1e"), "memory, MiB": _number(row.get("growth"), ".1f"),
            "cost": _number(row.get("cost"), ".2f"), "iterations": _number(row.get("iterations"), ".1f"),
        })  # fmt: skip
    return rows
