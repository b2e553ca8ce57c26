# SPDX-License-Identifier: MIT
"""Who assembles the matrix that a worker factorizes: bytes, step time, time from matrix to factor, on one host and over
1 Gbit/s (section 5 of Courtecuisse et al. 2010).

A cable of 1 Gbit/s is a network namespace at the end of a process that keeps packets back, where root may make one.
"""

from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Any

import typer

from tests.bench.build.runs import BYTES, CELLS, GIGABIT, SHARED, Case, copies, measured
from tests.bench.faults.net import Cable, Unavailable
from tests.bench.harness.report import Report, plots

EXPLAINED = """\
SOFA's bending beam (deploy/scenes/sofa_beam.toml), the loop running freely, one worker process, async: the next job
goes out when the last factor came. *none*: no job after the first factor, for comparison. *step CPU*: of the simulation
thread, mean; *service*: processor time of the thread beside the loop for all it does, by jobs; *worker*: assembly (if
it does that) and factorization; *to factor*: from the copy to the factor taken up, mean; *ms at 1 Gbit/s*: of the job's
bytes alone, computed. Factors come back as ever: 1 MB at 3000 tetrahedra, 17 MB at 24,000."""
COPIES = "Processor time that copying adds to a step of the loop, every third step with each, medians:"


def picture(rows: list[dict[str, Any]]) -> Any:
    """Time from matrix to factor by link and size."""
    plt = plots()
    figure, axes = plt.subplots(figsize=(8, 4.5), layout="constrained")
    cases = [row for row in rows if "to factor ms" in row]
    places = list(dict.fromkeys((row["tets"], row["link"]) for row in cases))
    for k, build in enumerate(("server", "worker")):
        own = {(row["tets"], row["link"]): row["to factor ms"] for row in cases if row["assembled by"] == build}
        axes.bar(
            [i + 0.4 * k for i in range(len(places))], [own[place] for place in places], 0.4, label=f"by the {build}"
        )
    axes.set_xticks([i + 0.2 for i in range(len(places))], [f"{tets}\n{way}" for tets, way in places], fontsize="small")
    axes.set(ylabel="from matrix to factor [ms]", yscale="log")
    axes.legend(title="assembled")
    return figure


def main(
    tets: Annotated[str, typer.Option(help=f"Sizes, of {', '.join(map(str, CELLS))}")] = "3000,24000",
    steps: Annotated[int, typer.Option(min=10, help="Counted steps at 3000 tetrahedra; a fifth at 24000")] = 1000,
    quick: Annotated[bool, typer.Option("--quick", help="A small smoke run")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/build]")] = None,
) -> None:
    """Matrices sent, or positions: bytes, step time and age of factors."""
    sizes, steps = ([540], 60) if quick else ([int(word) for word in tets.split(",")], steps)
    report = Report("build", "Who assembles the matrix", {"tets": sizes, "steps": steps}, out, quick)
    rows: list[dict[str, Any]] = []
    with ExitStack() as stack:
        ways = [SHARED, BYTES]
        if not quick:
            try:
                stack.enter_context(Cable()).pace(1000)
                ways.append(GIGABIT)
            except Unavailable as why:
                report.say(f"No cable of 1 Gbit/s here: {why}.")
        for size in sizes:
            for way, build in [(SHARED, "none"), *((way, build) for way in ways for build in ("server", "worker"))]:
                rows.append(measured(Case(size, way, build), steps if size < 24000 else max(20, steps // 5)))
                print({k: round(v, 3) if isinstance(v, float) else v for k, v in rows[-1].items()}, flush=True)
    copied = [copies(size, 10 if quick else 100) for size in sizes]
    report.say(EXPLAINED)
    report.table(rows, tuple(rows[-1]))
    report.say(COPIES)
    report.table(copied)
    report.figure(picture(rows), "build.png", "From matrix to factor, by link and size.")
    report.remember(rows, ("tets", "link", "assembled by"), ("step CPU ms", "to factor ms"))
    report.data |= {"rows": rows, "copies": copied}
    report.write()


if __name__ == "__main__":
    typer.run(main)
