# SPDX-License-Identifier: MIT
"""The benchmark of two GPUs, as far as it goes without any."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.bench.two_gpus import __main__ as two_gpus
from tests.docs.figures import ROOT, table_under


def piece(path: Path, tets: int, faster: float, commit: str) -> Path:
    rows = [{"tets": tets, "GPUs": g, "us p50": 10.0 * g, "faster": faster if g == 2 else None} for g in (1, 2)]
    machine = {"cpu": "one", "cores": 2, "governor": "none", "load": 0, "system": "Linux"}
    times = {"dgemm_ms": 1.0, "spmv_ms": 1.0}
    header = {"date": "2026-01-01", "commit": commit, "machine": machine, "versions": {}}
    device = {"gpu": "card", "driver": "1", "CUDA": "13.0"}
    content = {
        "header": header | {"calibration": {"before": times, "after": times}}, "arguments": {"sizes": [tets]},
        "data": {"device": device, "rows": rows},
    }  # fmt: skip
    path.write_text(json.dumps(content))
    return path


def test_pieces_become_one_page(tmp_path):
    pieces = [piece(tmp_path / "a.json", 405_600, 1.5, "a"), piece(tmp_path / "b.json", 98_304, 1.25, "b")]
    two_gpus.merge(pieces, tmp_path / "out")
    text = (tmp_path / "out" / "two_gpus.md").read_text()
    assert "commit b" in text and "Two card of one host" in text
    rows = table_under(text, "Steps")
    assert [(row["tets"], row["GPUs"], row["faster"]) for row in rows] == [
        ("98304", "1", "–"), ("98304", "2", "1.25"), ("405600", "1", "–"), ("405600", "2", "1.5")
    ]  # fmt: skip


@pytest.mark.system
def test_without_gpus_one_line_and_code_2(tmp_path):
    command = [sys.executable, "-m", "tests.bench.two_gpus", "--out", str(tmp_path)]
    environment = {**os.environ, "CUDA_VISIBLE_DEVICES": ""}
    result = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=120)
    assert result.returncode == 2 and result.stdout == ""
    assert result.stderr.startswith("bench two_gpus: ") and result.stderr.count("\n") == 1
