# SPDX-License-Identifier: MIT
"""A benchmark at its small size, in a process of its own."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]


def bench(name: str, out: Path, *arguments: str) -> dict[str, Any]:
    """What `python -m tests.bench.NAME --quick` writes as JSON; its other files are in `out` too."""
    command = [sys.executable, "-m", f"tests.bench.{name}", "--quick", "--out", str(out), *arguments]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=110)
    assert result.returncode == 0, result.stdout + result.stderr
    return json.loads((out / f"{name}.json").read_text())
