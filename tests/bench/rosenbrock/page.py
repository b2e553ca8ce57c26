# SPDX-License-Identifier: MIT
"""The page of bench rosenbrock: a section for each part that there are rows of."""

from collections.abc import Sequence
from typing import Any

from tests.bench.harness.report import Report, plots
from tests.bench.rosenbrock import precision, words
from tests.bench.rosenbrock.bars import STARTS, Row
from tests.bench.rosenbrock.stability import groups

Tables = dict[str, list[Row]]
MAIN = 3000  # tetrahedra of the first picture, if there are such rows
COLOURS = {
    "backward Euler": "C0", "newmark": "C2", "bdf2": "C4", "generalized_alpha": "C3", "ros2, iterate": "C1",
    "ros2, factor": "k",
}  # fmt: skip
VARIED = ("start", "model", "E MPa", "Poisson", "dt ms", "latency", "tangent", "bound / edge")  # of stability
REMEMBERED = ("3e-03", "1e-03")  # errors of the key figures


def write(report: Report, tables: Tables) -> None:
    """Page, pictures and JSON. tables: rows by the name of their table."""
    report.data |= {name: rows for name, rows in tables.items() if rows}
    report.say(words.SETUP)
    shown = {
        "precision": _precision, "times": _times, "ages": _ages, "stability": _stability, "undamped": _undamped,
        "free": _free, "limits": _limits,
    }  # fmt: skip
    devices = dict.fromkeys(row["device"] for rows in tables.values() for row in rows)
    for device in devices:
        for name, show in shown.items():
            if rows := [row for row in tables.get(name, []) if row["device"] == device]:
                show(report, device, rows)
    report.write()


def _heading(report: Report, device: str, title: str, *paragraphs: str) -> None:
    report.say(f"## {title}, {device.upper()}", *paragraphs)


def _by(rows: Sequence[Row], *names: str) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by the values of some columns, in the order of the rows."""
    keys = dict.fromkeys(tuple(row[n] for n in names) for row in rows)
    return {key: [row for row in rows if tuple(row[n] for n in names) == key] for key in keys}


def _size(row: Row) -> tuple[Any, ...]:
    """For sorting."""
    return row["tets"], row["material"] == "bands", row.get("E MPa", 0)


def _bar(tets: int, material: str, young: float) -> str:
    return f"{tets:,} tetrahedra, {'bands, ' if material == 'bands' else ''}E = {young:g} MPa"


# --- work and precision -----------------------------------------------------------------------------------------------


def _precision(report: Report, device: str, rows: list[Row]) -> None:
    _heading(report, device, "Work and precision", words.PRECISION)
    by_bar = _by(sorted(rows, key=_size), "tets", "material", "E MPa")
    cheapest = {key: precision.cheapest(points) for key, points in by_bar.items()}
    summary = []
    for (tets, material, young), costs in cheapest.items():
        ratios = {row["error / L"]: row["best other / ros2"] for row in costs}
        summary.append({"tets": tets, "material": material, "E MPa": young, **ratios})
    report.say(f"### Best other over ros2, {device.upper()}", words.SUMMARY)
    report.table(summary)
    report.remember(summary, ("tets", "material", "E MPa"), REMEMBERED)
    sizes = list(dict.fromkeys(key[0] for key in by_bar))
    main = MAIN if MAIN in sizes else sizes[0]
    for tets in sorted(sizes, key=lambda size: (size != main, size)):
        mine = {key: points for key, points in by_bar.items() if key[0] == tets}
        file = "rosenbrock" + ("" if tets == main else f"_{tets}") + ("" if device == "cpu" else f"_{device}")
        caption = f"Error of the motion against time, {tets:,} tetrahedra. Each point is a time step."
        report.figure(_picture(mine), f"{file}.png", caption)
        for key in mine:
            report.say(f"### {_bar(*key)}, {device.upper()}", words.milliseconds(device))
            report.table(cheapest[key])
    report.say(f"### All points, {device.upper()}", words.POINTS)
    for key, points in by_bar.items():
        apart = f"the two references are {points[0]['apart']:.0e} L apart" if points[0]["apart"] is not None else ""
        report.say(f"{_bar(*key)}; {points[0]['seconds']:g} s; {apart}:")
        report.table([_line(name[0], several) for name, several in _by(points, "method").items()])


def _line(name: str, points: list[Row]) -> Row:
    """Error and cost of a method at each time step."""
    found: Row = {"method": name}
    for p in sorted(points, key=lambda p: -p["dt ms"]):
        error = "apart" if p["error / L"] is None or p["error / L"] != p["error / L"] else f"{p['error / L']:.1e}"
        found[f"dt {p['dt ms']:g} ms"] = f"{error}, {p['ms / s']:.3g}"
    return found


def _looks(names: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Colour by scheme, marker by its settings."""
    seen: list[str] = []
    found = {}
    for name in names:
        scheme = next((known for known in COLOURS if name.startswith(known)), "")
        found[name] = {"color": COLOURS.get(scheme, "C7"), "marker": "os^D"[seen.count(scheme) % 4]}
        seen.append(scheme)
    return found


def _picture(by_bar: dict[tuple[Any, ...], list[Row]]) -> Any:
    plt = plots()
    columns = min(3, len(by_bar))
    lines = -(-len(by_bar) // columns)
    figure, axes = plt.subplots(
        lines, columns, figsize=(3 + 3.9 * columns, 3.8 * lines), squeeze=False, layout="constrained"
    )
    for axis in axes.flat[len(by_bar) :]:
        axis.set_visible(False)
    for axis, (key, points) in zip(axes.flat, by_bar.items(), strict=False):
        by_method = {name: several for (name,), several in _by(points, "method").items()}
        looks = _looks(list(by_method))
        for name, line in by_method.items():
            known = [p for p in sorted(line, key=lambda p: p["dt ms"]) if p["error / L"]]
            width = 2.2 if name.startswith("ros2, factor") else 1
            errors, costs = ([p[column] for p in known] for column in ("error / L", "ms / s"))
            axis.loglog(errors, costs, ms=4, lw=width, label=name, **looks[name])
        _, material, young = key
        axis.set(title=f"{'bands, ' if material == 'bands' else ''}E = {young:g} MPa", xlabel="rms error / L")
        axis.invert_xaxis()
        axis.grid(True, which="both", alpha=0.3)
    for axis in axes[:, 0]:
        axis.set_ylabel("ms a simulated second")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside right upper", fontsize=7)
    return figure


# --- the other parts --------------------------------------------------------------------------------------------------


def _times(report: Report, device: str, rows: list[Row]) -> None:
    _heading(report, device, "Step times", words.TIMES, words.clock(device))
    rows = sorted(rows, key=_size)
    hidden = ("device", *(() if device == "cpu" else ("assemble", "solve", "integrate")))
    report.table(rows, [name for name in rows[0] if name not in hidden])
    report.remember(rows, ("tets", "material", "method"), ("p50 ms",))


def _ages(report: Report, device: str, rows: list[Row]) -> None:
    _heading(report, device, "Age of the factor", words.AGES)
    for title, column in (
        ("Error of the motion / L", "error / L"),
        ("Median of the estimates of a step / L", "estimate / L"),
        ("Largest estimate of a step / L", "largest estimate / L"),
        ("Share of the steps by the factor alone", "by factor"),
    ):
        report.say(f"{title}:")
        lines = []
        for key, several in _by(rows, "matrix", "latency").items():
            cells = {f"dt {row['dt ms']:g} ms": row[column] for row in sorted(several, key=lambda row: row["dt ms"])}
            lines.append({"matrix": key[0], "age at least": key[1] or None, **cells})
        report.table([line for line in lines if line["age at least"] or column != "by factor"])


def _stability(report: Report, device: str, rows: list[Row]) -> None:
    _heading(report, device, "Does it hold?", words.STABILITY)
    report.table([{"start": name, "what is done": what} for name, (what, _) in STARTS.items()])
    report.say(words.STABILITY_COLUMNS)
    total = [
        {"varied": group, "cases": len(several), "hold": sum(row["holds"] == "yes" for row in several),
         "hold by backward Euler": sum(row["Euler: holds"] == "yes" for row in several)}
        for (group,), several in _by(rows, "varied").items()
    ]  # fmt: skip
    report.table(total)
    report.remember(total, ("varied",), ("hold",))
    for group in groups():
        if several := [row for row in rows if row["varied"] == group]:
            names = [n for n in VARIED if _differs(several, n)] or ["start"]
            report.say(f"### {group}, {device.upper()}")
            hidden = {"device", "varied", *VARIED}
            report.table(several, [*names, *(n for n in several[0] if n not in hidden)])


def _differs(rows: list[Row], name: str) -> bool:
    return len({row[name] for row in rows}) > 1


def _undamped(report: Report, device: str, rows: list[Row]) -> None:
    _heading(report, device, "Energy without damping", words.UNDAMPED)
    rows = sorted(rows, key=lambda row: row["dt ms"])
    report.table(rows, [name for name in rows[0] if name != "device"])
    report.remember(rows, ("dt ms", "method"), ("last over first quarter",))


def _free(report: Report, device: str, rows: list[Row]) -> None:
    _heading(report, device, "A free body", words.FREE)
    rows = sorted(rows, key=lambda row: row["dt ms"])
    report.table(rows, ["dt ms", "method", "linear", "angular", "energy at the end"])
    report.remember(rows, ("dt ms", "method"), ("linear", "angular"))


def _limits(report: Report, device: str, rows: list[Row]) -> None:
    _heading(report, device, "What it is not good for", words.LIMITS)
    report.table(rows, [name for name in rows[0] if name != "device"])
