# SPDX-License-Identifier: MIT
"""A benchmark at its small size, in a process of its own, and what each must write."""

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
UNKNOWN = ("age", "next factor")  # may be unknown in any bench
UNKNOWN_IN = {  # of other steps; no goal; not ours, or of a busy machine; without CHOLMOD, energy or GPU; not yet
    "accuracy": ("step error", "solve error"), "contact": ("goal ms", "loop ms"),
    "cpu": ("assemble", "iterations", "residual", "solve", "wall"), "factors": ("of CHOLMOD",),
    "rosenbrock": ("energy", "estimate"), "scale": ("back to", "GPU"), "speed": ("in use", "at most", "oldest"),
}  # fmt: skip
TIME = float(os.environ.get("PYTEST_TIMEOUT", 120)) - 10  # s, less than the test may take
WITHOUT_PICTURE = ("attacks", "faults", "gallery", "service", "speed")


def bench(name: str, out: Path, *arguments: str) -> dict[str, Any]:
    """What `python -m tests.bench.NAME --quick` writes as JSON; its other files are in `out` too."""
    command = [sys.executable, "-m", f"tests.bench.{name}", "--quick", "--out", str(out), *arguments]
    started = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    try:
        printed, said = started.communicate(timeout=TIME)
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(started.pid, signal.SIGKILL)  # what it has started, too: it would slow whatever runs next
    assert started.returncode == 0, printed + said
    assert "FAILED" not in printed
    return json.loads((out / f"{name}.json").read_text())


def leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """(path, value) of everything in parsed JSON that is no list or table."""
    if isinstance(value, dict):
        for name, inner in value.items():
            yield from leaves(inner, f"{key}.{name}")
    elif isinstance(value, list):
        for inner in value:
            yield from leaves(inner, key)
    else:
        yield key, value


def writes_its_report(name: str, out: Path, *arguments: str) -> None:
    """Runs it; finite numbers, a head, a text and a picture must be there. How long anything took is not looked at."""
    content = bench(name, out, *arguments)
    numbers = [v for _, v in leaves(content["data"]) if isinstance(v, int | float)]
    assert len(numbers) > 20 and all(math.isfinite(v) for v in numbers)
    missing = {key for key, v in leaves(content["data"]) if v is None}
    assert all(any(word in key for word in (*UNKNOWN, *UNKNOWN_IN.get(name, ()))) for key in missing), missing

    header = content["header"]
    assert {"date", "commit", "machine", "versions", "calibration"} <= set(header)
    assert all(v > 0 for _, v in leaves(header["calibration"]))
    text = (out / f"{name}.md").read_text()
    assert header["machine"]["cpu"] in text
    if name not in WITHOUT_PICTURE:
        assert f"]({name}.png)" in text
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG")
