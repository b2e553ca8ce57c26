# SPDX-License-Identifier: MIT
"""Figure 4 of Courtecuisse et al. 2010: iterations and time of each step under six update schemes."""

import tempfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from tests.bench._schemes import SCENES, Run, Scheme, run
from tests.bench.report import Report, plots

FACTOR = "preconditioner=cholesky"


def schemes(latency: int, processes: bool) -> list[Scheme]:
    """Those of the figure, and the asynchronous ones once more with a real worker."""
    d = latency
    found = [
        Scheme("CG", ("preconditioner=none",)),
        Scheme("PCG-0", (FACTOR, "update=never", "warp=false")),
        Scheme("PCG-1", (FACTOR, "update=every-1", "warp=false")),
        Scheme(f"PCG-{d}", (FACTOR, f"update=every-{d}", "warp=false")),
        Scheme(f"PCG-{d} (async)", (FACTOR, f"update=lockstep-{d}", "warp=false")),
        Scheme(f"PCG-{d} (async+warp)", (FACTOR, f"update=lockstep-{d}", "warp=true")),
    ]
    real = [
        Scheme(f"real async{words}{pace}", (FACTOR, "update=async", f"warp={warp}"), True, realtime)
        for realtime, pace in ((False, ""), (True, ", real time"))
        for warp, words in (("false", ""), ("true", "+warp"))
    ]
    return [*found, *real] if processes else found


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


def row(name: str, runs: list[Run], start: int) -> dict[str, Any]:
    """Over the steps after `start`; times: median over the repetitions of each run's quantile."""
    first = runs[0]
    quantiles = np.median([1e3 * np.percentile(r.seconds[start:], [50, 99, 100]) for r in runs], axis=0)
    iterations = np.concatenate([r.iterations[start:] for r in runs])
    age = np.concatenate([r.age[start:] for r in runs])
    known = np.isfinite(age)
    return {
        "scheme": name,
        "iterations, mean": float(iterations.mean()),
        "iterations, max": float(iterations.max()),
        "step p50 [ms]": quantiles[0],
        "step p99 [ms]": quantiles[1],
        "step max [ms]": quantiles[2],
        "factor age, mean": float(age[known].mean()) if known.any() else float("nan"),
        "factor age, max": float(age[known].max()) if known.any() else float("nan"),
        "first steps, mean iterations": float(first.iterations[:start].mean()) if start else float("nan"),
        "without factor": sum(int((~np.isfinite(r.age[start:])).sum()) for r in runs) / len(runs),
        "unconverged": sum(s != "converged" for r in runs for s in r.status),
    }


def pictures(results: dict[str, list[Run]], start: int) -> Any:
    """(a) iterations and (b) time against the step number."""
    plt = plots()
    figure, axes = plt.subplots(2, 1, figsize=(10, 9), sharex=True, layout="constrained")
    for name, runs in results.items():
        step = np.arange(1, len(runs[0].iterations) + 1)
        style = ":" if "time" in name else "--" if name.startswith("real") else "-"
        axes[0].plot(step, runs[0].iterations, style, lw=1.2, label=name)
        axes[1].plot(step, 1e3 * np.median([r.seconds for r in runs], axis=0), style, lw=1.2, label=name)
    for axis, label in zip(axes, ("(a) iterations", "(b) time per step [ms]"), strict=True):
        axis.axvspan(0.5, start + 0.5, color="0.9", zorder=0)
        axis.set(ylabel=label, yscale="log")
        axis.grid(True, which="both", alpha=0.3)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=5, fontsize="small")
    axes[1].set_xlabel(f"step (grey: lockstep-{start} has no factor yet)")
    return figure


def order(rows: list[dict[str, Any]], latency: int) -> str:
    """What the figure must show, in numbers."""
    mean = {r["scheme"]: r["iterations, mean"] for r in rows}
    warp = mean[f"PCG-{latency} (async+warp)"]
    return (
        f"Mean iterations of async+warp: {100 * warp / mean[f'PCG-{latency} (async)']:.0f} % of async without warp "
        f"(must be at most 60 %), {100 * warp / mean['CG']:.1f} % of CG (must be at most 10 %)."
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
    report.data["runs"] = {
        name: {"iterations": [r.iterations for r in runs], "seconds": [r.seconds for r in runs],
               "age": [r.age for r in runs]}
        for name, runs in results.items()
    }  # fmt: skip
    report.write()


if __name__ == "__main__":
    typer.run(main)
