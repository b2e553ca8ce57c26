# SPDX-License-Identifier: MIT
"""The page of the scaling benchmark: devices side by side, all rows, a picture."""

from typing import Any

from tests.bench.harness.report import Report, plots

Row = dict[str, Any]
KEYS = ("objects", "server", "workers", "workers on")  # what tells rows apart
STYLES = {("cpu", "cpu"): "o-", ("gpu", "gpu"): "s--", ("gpu", "cpu"): "^:", ("cpu", "gpu"): "v-."}
SETTING = (
    "Beams of 540 tetrahedra (176 nodes), E 1 to 4 MPa, dt 20 ms, tolerance 1e-6 of the true residual, as fast as it "
    "goes; every 100 steps the beams are put back to where they started. On a CPU the loop has one thread. Measured "
    "once every beam has a factor, or after the time that `warm` allows; those without one are solved with block "
    "Jacobi. Age: of the factor that a solve used, from the matrix it was made from; in ms at the mean pace. Server "
    "and workers share the cores named above. Records dropped: of solves that the service thread did not read in time; "
    "steps are counted by the loop."
)


def write(report: Report, rows: list[Row]) -> None:
    """Page, pictures and JSON."""
    rows = sorted(rows, key=lambda r: (r["objects"], r["workers"], r["server"], r["workers on"]))
    report.data["rows"] = rows
    report.remember(rows, KEYS, ("object-steps/s", "age p50, steps"))
    report.say(SETTING)
    if len(_pairs(rows)) > 1:
        report.say("## Side by side")
        report.table(side_by_side(rows))
    report.say("## All figures")
    report.table(rows)
    draw(report, rows)
    report.write()


def _pairs(rows: list[Row]) -> list[tuple[str, str]]:
    return sorted({(r["server"], r["workers on"]) for r in rows})


def _named(pair: tuple[str, str]) -> str:
    server, workers = (d.upper() for d in pair)
    return server if server == workers else f"{server}, workers on {workers}"


def side_by_side(rows: list[Row]) -> list[Row]:
    """A row for each number of objects and workers: throughput, age of the factors and step time on each device."""
    by = {tuple(r[k] for k in KEYS): r for r in rows}
    out = []
    for objects, workers in sorted({(r["objects"], r["workers"]) for r in rows}):
        line: Row = {"objects": objects, "workers": workers}
        for what in ("object-steps/s", "age p50 / max, steps", "step p50 / p99, ms"):
            for pair in _pairs(rows):
                line[f"{what}, {_named(pair)}"] = _cell(by.get((objects, pair[0], workers, pair[1])), what)
        out.append(line)
    return out


def _cell(row: Row | None, what: str) -> Any:
    if row is None or what in row:
        return row[what] if row else None
    names = ("age p50, steps", "age max, steps") if what.startswith("age") else ("step ms p50", "step ms p99")
    return " / ".join("–" if row[n] is None else f"{row[n]:.3g}" for n in names)


def draw(report: Report, rows: list[Row]) -> None:
    """Throughput, age and step time over the number of bodies: a colour for each number of workers, a mark for each
    pair of devices."""
    try:
        plt = plots()
    except ImportError:
        report.say("No picture: matplotlib is not installed where this page was made.")
        return
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.5), layout="constrained")
    counts = sorted({r["workers"] for r in rows})
    for name, plot in zip(("object-steps/s", "age p50, ms", "step ms p50"), axes, strict=True):
        for pair in _pairs(rows):
            for workers in counts:
                mine = [r for r in rows if (r["server"], r["workers on"], r["workers"]) == (*pair, workers) and r[name]]
                label, colour = f"{_named(pair)}, {workers} workers", f"C{counts.index(workers)}"
                if mine:
                    plot.loglog(
                        [r["objects"] for r in mine], [r[name] for r in mine], STYLES[pair], ms=4, color=colour,
                        label=label,
                    )  # fmt: skip
        plot.set(xlabel="objects", title=name)
        plot.grid(True, alpha=0.3)
    axes[0].legend(fontsize=7)
    caption = "Throughput, median age of the factors in use, median time of a step of all bodies."
    report.figure(figure, "scaling.png", caption)
