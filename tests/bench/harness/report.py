# SPDX-License-Identifier: MIT
"""What every benchmark writes: Markdown, JSON and pictures under out/bench/NAME, headed by where and when.

The calibration (a dense and a sparse product on one thread, before and after) lets figures of different machines, or of
one machine on a good and a bad day, be compared. Run by itself it prints only that.
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: the calibration is of one thread

import datetime
import json
import math
import platform
import subprocess
import time
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.bench.harness import history

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROOT = Path(__file__).resolve().parents[3]
PACKAGES = ("warpfactor", "numpy", "scipy", "scikit-sparse", "eclipse-zenoh")


def best_of(times: int, run: Callable[[], Any]) -> float:
    """Least wall time of a call [s]."""
    seconds = []
    for _ in range(times):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


@cache
def _products(quick: bool) -> tuple[Callable[[], Any], Callable[[], Any]]:
    from scipy.sparse import random_array

    rng = np.random.default_rng(0)
    n, m = (200, 2000) if quick else (1000, 20_000)
    dense = rng.normal(size=(n, n))
    sparse = random_array((m, m), density=40 / m, rng=rng).tocsr()
    vector = rng.normal(size=m)
    return (lambda: dense @ dense), (lambda: sparse @ vector)


def calibration(quick: bool = False) -> dict[str, float]:
    """dgemm 1000 x 1000 and CSR times vector (20000 rows, 800 k nonzeros), least of ten [ms]; quick: smaller ones."""
    dense, sparse = _products(quick)
    return {"dgemm_ms": 1e3 * best_of(10, dense), "spmv_ms": 1e3 * best_of(10, sparse)}


def _first_line(command: list[str]) -> str:
    try:
        result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    except OSError:
        return ""
    return "" if result.returncode else result.stdout.strip().split("\n")[0]


def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "absent"


def machine() -> dict[str, Any]:
    """Processor, cores, first GPU (empty without one), governor, load, operating system."""
    try:
        cpu = next(line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name"))
    except (OSError, StopIteration):
        cpu = platform.processor()
    governor = Path("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    return {
        "cpu": cpu.split(":")[-1].strip(),
        "cores": os.cpu_count(),
        "gpu": _first_line(["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]),
        "governor": governor.read_text().strip() if governor.exists() else "unknown",
        "load": round(os.getloadavg()[0], 2),
        "system": f"{platform.system()} {platform.release()}",
    }


def versions() -> dict[str, str]:
    """Of Python, the packages that count, the factorization library and the compiler."""
    from precond_worker.factorization.factorize import default_library
    from sim_server.backends.compiler import compiler

    found = {"python": platform.python_version(), **{p: _version(p) for p in PACKAGES}}
    return {**found, "factorization": default_library(), "compiler": _first_line([compiler(), "--version"])}


def commit() -> str:
    """Of the working tree; "-dirty" where files differ from it. WARPFACTOR_COMMIT says it where there is no git."""
    return os.environ.get("WARPFACTOR_COMMIT") or _first_line(["git", "describe", "--always", "--dirty"]) or "unknown"


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return "–"
    if not isinstance(value, float):
        return str(value)
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def table(rows: Sequence[dict[str, Any]], columns: Sequence[str] = ()) -> str:
    """A Markdown table; columns: keys of the rows, all of the first row by default. Numbers to three digits."""
    columns = columns or list(rows[0])
    lines = ["| " + " | ".join(columns) + " |", "|" + "|".join(" --- " for _ in columns) + "|"]
    lines += ["| " + " | ".join(_cell(row.get(c)) for c in columns) + " |" for row in rows]
    return "\n".join(lines)


def plain(value: Any) -> Any:
    """For JSON: NumPy to Python, what is not finite to null."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


class Report:
    """Collects what a benchmark found; `write` puts it into its folder.

    name: of the benchmark; title: first line; arguments: what it ran with; out: folder, default out/bench/NAME.
    """

    def __init__(self, name: str, title: str, arguments: dict[str, Any], out: Path | None = None, quick: bool = False):
        self.name, self.title, self.arguments, self.quick = name, title, arguments, quick
        self.out = out
        self.folder = out or ROOT / "out" / "bench" / name
        self.folder.mkdir(parents=True, exist_ok=True)
        self.data: dict[str, Any] = {}
        self.key_figures: dict[str, float] = {}
        self._body: list[str] = []
        self._started = datetime.datetime.now().astimezone()
        self._machine, self._commit, self._before = machine(), commit(), calibration(quick)

    def seconds(self) -> float:
        """Wall time since it began [s]."""
        return (datetime.datetime.now().astimezone() - self._started).total_seconds()

    def say(self, *paragraphs: str) -> None:
        """Adds paragraphs, tables, headings."""
        self._body += paragraphs

    def table(self, rows: Sequence[dict[str, Any]], columns: Sequence[str] = ()) -> None:
        """Adds a table (see the function of that name)."""
        self._body.append(table(rows, columns))

    def figure(self, figure: "Figure", file: str, caption: str) -> None:
        """Saves a picture beside the Markdown and shows it there."""
        figure.savefig(self.folder / file, dpi=110)
        self._body.append(f"![{caption}]({file})\n\n{caption}")

    def remember(self, rows: Sequence[dict[str, Any]], names: Sequence[str], values: Sequence[str]) -> None:
        """Adds key figures to the line that `write` adds to the history (see history.figures)."""
        self.key_figures |= history.figures(rows, names, values)

    def head(self) -> dict[str, Any]:
        """Where, when and with what, as at the start."""
        return {
            "date": self._started.isoformat(timespec="seconds"),
            "commit": self._commit,
            "machine": self._machine,
            "versions": versions(),
        }

    def header(self) -> dict[str, Any]:
        """The same, with the calibration before and now."""
        return self.head() | {"calibration": {"before": self._before, "after": calibration(self.quick)}}

    def markdown(self, header: dict[str, Any]) -> str:
        """The whole text."""
        m, before, after = header["machine"], header["calibration"]["before"], header["calibration"]["after"]
        sizes = "200, 80 k nonzeros; smoke run" if self.quick else "1000, 800 k nonzeros"
        lines = [
            f"# {self.title}",
            ", ".join([f"`deploy/run bench {self.name}`", *(f"{k} = {_list(v)}" for k, v in self.arguments.items())]),
            f"- {header['date']}, commit {header['commit']}",
            f"- {m['cpu']}, {m['cores']} cores, governor {m['governor']}, load {m['load']} at the start; {m['system']}",
            "- " + ", ".join(f"{k} {v}" for k, v in header["versions"].items()),
            f"- calibration, one thread, before → after (dgemm and CSR product of {sizes}): dgemm "
            f"{before['dgemm_ms']:.3g} → {after['dgemm_ms']:.3g} ms, "
            f"SpMV {before['spmv_ms']:.3g} → {after['spmv_ms']:.3g} ms",
        ]
        return "\n\n".join([lines[0], lines[1], "\n".join(lines[2:]), *self._body]) + "\n"

    def write(self) -> Path:
        """NAME.md and NAME.json; returns the folder. A whole run into its usual folder adds a line to the history."""
        header = self.header()
        if self.key_figures and self.out is None and not self.quick:
            arguments = plain(self.arguments)
            history.append(history.entry(self.name, header, arguments, self.key_figures), history.FILE)
        (self.folder / f"{self.name}.md").write_text(self.markdown(header))
        self.save(header)
        print(f"written: {self.folder}/{self.name}.md, .json and pictures", flush=True)
        return self.folder

    def save(self, header: dict[str, Any]) -> None:
        """NAME.json alone."""
        content = {"header": header, "arguments": self.arguments, "data": self.data}
        (self.folder / f"{self.name}.json").write_text(json.dumps(plain(content), indent=1, allow_nan=False) + "\n")


def _list(value: Any) -> str:
    many = isinstance(value, Iterable) and not isinstance(value, str)
    return " ".join(_list(v) for v in value) if many else f"{value:g}" if isinstance(value, float) else str(value)


def plots() -> Any:
    """matplotlib.pyplot, drawing to files only."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot

    return matplotlib.pyplot


if __name__ == "__main__":
    print(json.dumps({"machine": machine(), "versions": versions(), "calibration": calibration()}, indent=1))
