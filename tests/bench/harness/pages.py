# SPDX-License-Identifier: MIT
"""Brings what the benchmarks found into the documents: pages under docs/bench, and the table of the README.

Run it after the benchmarks whose results shall be shown; it copies their Markdown and pictures as they are, and fills
the README between the marks. So no figure in a document is typed by hand.
"""

import json
import shutil
from pathlib import Path
from typing import Any

from tests.bench.harness.report import ROOT, table

FIRST = ("cpu", "gpu", "models", "paper", "figure4", "warp", "preconditioners", "build")
PAGES = (*FIRST, "verification", "accuracy", "hard_cases", "scheduler", "scaling", "faults")
README = ROOT / "README.md"


def copied(name: str, out: Path, docs: Path) -> bool:
    """Copies one benchmark's page and pictures; False if it has not been run."""
    page = out / name / f"{name}.md"
    if not page.exists():
        return False
    docs.mkdir(parents=True, exist_ok=True)
    for file in [page, *sorted((out / name).glob("*.png"))]:
        shutil.copyfile(file, docs / file.name)
    return True


def cpu_table(found: dict[str, Any]) -> str:
    """Of the README: a step's CPU time at the paper's sizes, ours and others'."""
    rows = found["data"]["rows"]
    by = {(row["tets"], row["scheme"]): row for row in rows}
    lines = []
    for tets in sorted({row["tets"] for row in rows}):
        ours = by[tets, "async + warp"]
        lines.append(
            {
                "tetrahedra": f"{tets:,}",
                "**Warpfactor**": f"**{ours['CPU ms']:.3g} ms**",
                "iterations": ours["iterations"],
                "step p50 / p99": f"{ours['wall p50']:.3g} / {ours['wall p99']:.3g} ms",
                "plain CG, ours": f"{by[tets, 'CG']['CPU ms']:.3g} ms",
                "SciPy + CHOLMOD each step": f"{by[tets, 'SciPy + CHOLMOD each step']['CPU ms']:.3g} ms",
            }
        )
    machine = found["header"]["machine"]
    dgemm = found["header"]["calibration"]["before"]["dgemm_ms"]
    return (
        "CPU time of the simulation thread per step, SOFA's bending beam (E 3 MPa, dt 20 ms), tolerance 1e-6 of the "
        f"true residual, one thread, one worker process beside it, as fast as it goes; {machine['cpu']}, "
        f"{machine['cores']} cores, dgemm 1000 in {dgemm:.0f} ms ([all of it](docs/bench/cpu.md)):\n\n{table(lines)}"
    )


def gpu_table(found: dict[str, Any]) -> str:
    """Of the README: a step's time on a GPU, ours beside a direct solver and plain CG on the same one."""
    data = found["data"]
    direct = {row["tets"]: row.get("us") for row in data["others"] if row["what"] == "cuDSS, float64"}
    lines = []
    for row in (r for r in data["steps"] if r["material"] == "homogeneous" and not r["settings"]):
        alone, beams = row["beams"] == 1, row["beams"]
        lines.append(
            {
                "scene": f"{row['tets']:,} tetrahedra" if alone else f"{beams} beams of {row['tets']:,}",
                "**Warpfactor**": f"**{_time(row['us p50'])}**",
                "p99": _time(row["us p99"]),
                "iterations": row["iterations"],
                "true residual": row["residual"],
                "plain CG, ours": _time(row.get("CG us")),
                "cuDSS each step, without assembly": _time(direct.get(row["tets"]) if alone else None),
            }
        )
    device = data["device"]
    return (
        "Time of a whole step on the device, homogeneous beam let go from horizontal (E 1 MPa, dt 30 ms), tolerance "
        f"1e-6, factor at most 16 steps old; {device['gpu']}, driver {device['driver']}, copy "
        f"{device['copy TB/s']:.3g} TB/s ([all of it](docs/bench/gpu.md)):\n\n{table(lines)}"
    )


def _time(us: float | None) -> str | None:
    if us is None:
        return None
    return f"{us:.0f} µs" if us < 1000 else f"{us / 1000:.3g} ms"


def filled(text: str, mark: str, content: str) -> str:
    """The text with what stands between <!-- mark --> and <!-- /mark --> replaced."""
    begin, end = f"<!-- {mark} -->", f"<!-- /{mark} -->"
    head, _, rest = text.partition(begin)
    _, _, tail = rest.partition(end)
    if not tail:
        raise SystemExit(f"README.md has no marks {begin} {end}")
    return f"{head}{begin}\n{content}\n{end}{tail}"


def main() -> None:
    out, docs = ROOT / "out" / "bench", ROOT / "docs" / "bench"
    for name in PAGES:
        print(f"{name}: {'docs/bench' if copied(name, out, docs) else 'not run, page left as it is'}")
    for name, made in (("cpu", cpu_table), ("gpu", gpu_table)):
        results = out / name / f"{name}.json"
        if results.exists() and f"<!-- {name} -->" in README.read_text():
            README.write_text(filled(README.read_text(), name, made(json.loads(results.read_text()))))
            print(f"README.md: table of steps on a {name.upper()}")


if __name__ == "__main__":
    main()
