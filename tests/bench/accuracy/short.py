# SPDX-License-Identifier: MIT
"""The three sentences of the page, each made of its rows."""

from collections.abc import Iterable, Sequence

from clients.accuracy.sources import length
from tests.bench.accuracy.axes import EXPLICIT_NAME, SCHEME, STEPS
from tests.bench.accuracy.cases import RUBBER
from tests.bench.accuracy.peers import US
from tests.bench.accuracy.sources import sentence
from tests.bench.harness.pieces import Row

BOUNDS = (1e-2, 1e-3)  # errors over L
Tables = dict[str, list[Row]]


def cheapest(rows: Iterable[Row], bound: float) -> Row | None:
    """Of those with an error over L of at most bound, the one that takes the least time."""
    fit = [r for r in rows if r["status"] == "done" and r["error"] is not None and r["seconds"] is not None]
    fit = [r for r in fit if r["error"] <= bound * r["length"]]
    return min(fit, key=lambda r: r["seconds"], default=None)


def called(row: Row) -> str:
    """A point in words."""
    return f"{row['series']}, {row['value']}"


def sentences(tables: Tables, device: str) -> list[str]:
    """Which error dominates, what an error costs, what it costs others; as far as there are rows."""
    found = []
    sources = [row for row in tables.get("sources", []) if row["scene"] == RUBBER.name]
    if sources:
        found.append(sentence(RUBBER.name, {row["source"]: row["error"] for row in sources}))
    points = [
        r for r in tables.get("points", []) if (r["device"], r["scene"], r["axis"]) == (device, RUBBER.name, SCHEME)
    ]
    if said := what_it_costs(points):
        found.append(said)
    others = [row for row in tables.get("peers", []) if row["device"] in (device, "cpu")]
    if said := beside_others(others):
        found.append(said)
    return found


def what_it_costs(points: Sequence[Row]) -> str:
    """The cheapest point for each bound, that of implicit steps if it is none, and the best of backward Euler."""
    implicit = [row for row in points if not row["series"].startswith(EXPLICIT_NAME)]
    parts = []
    for bound in BOUNDS:
        if (best := cheapest(points, bound)) is None:
            continue
        part = f"{best['seconds']:.2g} s ({called(best)}) with an error of {100 * bound:g} % of the length"
        if best not in implicit and (other := cheapest(implicit, bound)) is not None:
            part += f", by implicit steps {other['seconds']:.2g} s ({called(other)})"
        parts.append(part)
    euler = [r for r in points if r["series"].startswith("backward Euler") and r["error"] is not None]
    if not parts:
        return ""
    said = f"A simulated second takes {'; '.join(parts)}"
    if euler:
        best = min(euler, key=lambda r: r["error"])
        said += f"; backward Euler gets to {length(best['error'])} with {best['seconds']:.2g} s ({best['value']})"
    return f"{said}."


def beside_others(rows: Sequence[Row]) -> str:
    """By stiffness the cheapest of ours and of others for the smaller bound."""
    parts = []
    for young in dict.fromkeys(row["E MPa"] for row in rows):
        mine = [row for row in rows if row["E MPa"] == young]
        ours = cheapest((row for row in mine if row["who"] == US), BOUNDS[-1])
        theirs = cheapest((row for row in mine if row["who"] != US), BOUNDS[-1])
        if ours is not None and theirs is not None:
            parts.append(
                f"with E = {young:g} MPa {ours['seconds']:.2g} s here ({called(ours)}) and {theirs['seconds']:.2g} s "
                f"by the cheapest of others ({theirs['who']} {called(theirs)})"
            )
    return f"An error of {100 * BOUNDS[-1]:g} % of the length takes {'; '.join(parts)}." if parts else ""


def position_sentence(rows: Sequence[Row]) -> list[str]:
    """Of each bound in metres: the fixed settings that are at least as exact, and how many of them are cheaper.

    rows: of a scene and the axis STEPS.
    """
    assert all(row["axis"] == STEPS for row in rows)
    found = []
    for bound in (row for row in rows if row["series"] == "position" and row["step error"] is not None):
        exact = [r for r in rows if r["series"] not in ("position", "up to 8") and r["step error"] is not None]
        exact = [r for r in exact if r["step error"] <= bound["step error"]]
        fewer = [r for r in exact if r["iterations"] < bound["iterations"]]
        faster = [r for r in exact if r["seconds"] < bound["seconds"]]
        found.append(
            f"position = {bound['value']}: error of the steps {length(bound['step error'])}, "
            f"{bound['iterations']:.3g} iterations a step; of {len(exact)} fixed settings at least as exact "
            f"{len(fewer)} need fewer iterations and {len(faster)} less time."
        )
    return found
