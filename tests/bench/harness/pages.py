# SPDX-License-Identifier: MIT
"""Brings what the benchmarks found into the documents: pages under docs/bench, and their figures in README and docs.

Run it after the benchmarks whose results shall be shown; it copies their Markdown and pictures as they are, and fills
the marks of other documents from them (tests/docs/figures.py). So no figure in a document is typed by hand.
"""

import shutil
from pathlib import Path

from tests.bench.harness.report import ROOT
from tests.docs import figures

FIRST = ("cpu", "gpu", "speed", "models", "paper", "figure4", "warp", "preconditioners", "build")
PAGES = (
    *FIRST,
    "rosenbrock",
    "explicit",
    "contact",
    "cutting",
    "verification",
    "accuracy",
    "hard_cases",
    "effects",
    "factors",
    "scheduler",
    "scaling",
    "service",
    "haptics",
    "gallery",
    "web",
    "faults",
    "attacks",
    "scale",
    "fuzz",
    "soak",
)


def copied(name: str, out: Path, docs: Path) -> bool:
    """Copies one benchmark's page, pictures and tables; False if it has not been run."""
    page = out / name / f"{name}.md"
    if not page.exists():
        return False
    docs.mkdir(parents=True, exist_ok=True)
    for file in [page, *sorted((out / name).glob("*.png")), *sorted((out / name).glob("*.csv"))]:
        shutil.copyfile(file, docs / file.name)
    return True


def main() -> None:
    out, docs = ROOT / "out" / "bench", ROOT / "docs" / "bench"
    for name in PAGES:
        print(f"{name}: {'docs/bench' if copied(name, out, docs) else 'not run, page left as it is'}")
    figures.main()


if __name__ == "__main__":
    main()
