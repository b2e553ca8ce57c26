# SPDX-License-Identifier: MIT
"""Figure 4 of Courtecuisse et al. 2010: iterations and time of each step under six update schemes."""

import tempfile
from pathlib import Path
from typing import Annotated

import typer

from tests.bench.figure4.figure import order, pictures, row, schemes
from tests.bench.harness.report import Report
from tests.bench.harness.schemes import SCENES, Run, run


def _explained(d: int) -> tuple[str, str, str]:
    return (
        """\
After Courtecuisse et al. 2010, figure 4: a corotational beam bends under gravity, dt = 0.02 s, tolerance 1e-6 of the
true residual. Exact Cholesky factors in float32 here, incomplete ones in the paper.""",
        f"""\
PCG-0, PCG-1 and PCG-{d} factorize within the step, and their step time includes it. Async in this figure is
lockstep-{d}: the factor of the matrix of step t is used from step t + {d} to t + {2 * d - 1}, as if factorizing took
that long; the factorization is made between the steps and is not in the step time. *real* is sim-server with one worker
process on the same cores, running freely or (real time) a step each 0.02 s: its factors are as old as the worker is
slow, and its step time is the server's while the worker computes.""",
        f"""\
The start is not alike: PCG-0, PCG-1 and PCG-{d} have a factor at the first step, lockstep-{d} has none before step
{d + 1} and *real* none before the worker's first (block Jacobi until then). The table is over the steps after {d} for
every scheme; "without factor" counts those among them that still had none.""",
    )


def main(
    steps: Annotated[int, typer.Option(min=2, help="Steps of each run")] = 150,
    latency: Annotated[int, typer.Option(min=1, help="The 30 of PCG-30")] = 30,
    rounds: Annotated[int, typer.Option(min=1, help="Repetitions, the schemes taking turns")] = 3,
    processes: Annotated[bool, typer.Option(help="Also with a real worker process")] = True,
    scene: Annotated[Path, typer.Option(help="Scene file")] = SCENES / "beam.toml",
    quick: Annotated[bool, typer.Option("--quick", help="A small smoke run")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the results [default: out/bench/figure4]")] = None,
) -> None:
    """Iterations and time of each step of a beam that bends under gravity, under the update schemes of the paper."""
    more: tuple[str, ...] = ("solver.factor_precision=float32", "record.every=100000")
    if quick:
        steps, latency, rounds, more = 24, 6, 1, (*more, "object.beam.mesh.bar=[2, 2, 6]")
    arguments = {"scene": scene.name, "steps": steps, "latency": latency, "rounds": rounds, "processes": processes}
    report = Report("figure4", "Update schemes of the preconditioner, step by step", arguments, out, quick)
    kinds = schemes(latency, processes)
    results: dict[str, list[Run]] = {kind.name: [] for kind in kinds}
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(rounds):
            for kind in kinds:
                count = 100 if quick and kind.realtime else steps  # until a worker has started and answered
                results[kind.name].append(run(scene, kind, count, more, Path(folder)))
                print(f"{kind.name}: {results[kind.name][-1].iterations.mean():.1f} iterations")
    rows = [row(name, runs, latency) for name, runs in results.items()]
    report.say(*_explained(latency))
    report.figure(pictures(results, latency), "figure4.png", "Iterations and time of each step.")
    report.table(rows)
    report.say(order(rows, latency))
    report.data["rows"] = rows
    report.remember(rows, ("scheme",), ("iterations, mean", "step p50 [ms]"))
    report.data["runs"] = {
        name: {"iterations": [r.iterations for r in runs], "seconds": [r.seconds for r in runs],
               "age": [r.age for r in runs]}
        for name, runs in results.items()
    }  # fmt: skip
    report.write()


if __name__ == "__main__":
    typer.run(main)
