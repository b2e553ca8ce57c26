# SPDX-License-Identifier: MIT
"""The schemes of figure 4, a row and a picture of their runs; the page of the paper shows them too."""

from typing import Any

import numpy as np

from tests.bench.harness.report import plots
from tests.bench.harness.schemes import Run, Scheme

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
