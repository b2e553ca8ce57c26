# SPDX-License-Identifier: MIT
"""`--max-objects`, `--max-memory`: scenes that are too large are refused before anything is allocated."""

import subprocess
import sys
from pathlib import Path

import pytest

from sim_server.errors import InputError
from sim_server.scene import load
from sim_server.scene.size_limits import SizeLimits, estimate

ROOT = Path(__file__).parents[2]
OBJECT = """
[[object]]
name = "{name}"
mesh = {{ bar = {bar}, size = [1, 1, 1] }}
[object.effects]
corotational = {{ young = 1e6, poisson = 0.4 }}
"""


def scene(folder: Path, *bars: list[int]) -> Path:
    path = folder / "s.toml"
    path.write_text("dt = 0.02\n" + "".join(OBJECT.format(name=f"o{k}", bar=bar) for k, bar in enumerate(bars)))
    return path


def test_a_scene_within_the_limits_passes(tmp_path: Path) -> None:
    SizeLimits(2, 200e6).check(load(scene(tmp_path, [2, 2, 2], [3, 3, 3])))


def test_too_many_objects(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="has 3 objects; --max-objects allows 2"):
        SizeLimits(2).check(load(scene(tmp_path, [1, 1, 1], [1, 1, 1], [1, 1, 1])))


def test_too_much_memory_names_what_is_too_large(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"needs about \d+ GB of memory for 6000006 tets for the first 2 of its"):
        SizeLimits(None, 4e9).check(load(scene(tmp_path, [1, 1, 1], [100, 100, 100], [1, 1, 1])))


def test_nothing_is_allocated_before(tmp_path: Path) -> None:
    """A bar of 6 million tets is refused by a process that may have a twentieth of what it needs."""
    code = (
        "import resource, sys\n"
        "from sim_server.cli import main\n"
        "resource.setrlimit(resource.RLIMIT_DATA, (1 << 30, 1 << 30))\n"
        "main()\n"
    )
    arguments = [str(scene(tmp_path, [100, 100, 100])), "--device", "cpu", "--max-memory", "4GB"]
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=100
    )
    assert done.returncode == 2, done.stderr
    assert len(done.stderr.splitlines()) == 1 and "--max-memory allows 4 GB" in done.stderr
    assert "scene s.toml" in done.stderr


def test_a_mesh_in_a_file_is_counted(tmp_path: Path) -> None:
    mesh = ROOT / "deploy" / "scenes" / "hollow_finger.msh"
    path = tmp_path / "f.toml"
    path.write_text(OBJECT.format(name="finger", bar=[1, 1, 1]).replace(
        "bar = [1, 1, 1], size = [1, 1, 1]", f'file = "{mesh}"'
    ).replace("\n[[", "dt = 0.02\n[[", 1))  # fmt: skip
    with pytest.raises(InputError, match="--max-memory allows"):
        SizeLimits(None, 80.1e6).check(load(path))


def test_the_estimate_grows_as_measured() -> None:
    """Largest resident memory of servers with a worker and a log, 40 steps [bytes]."""
    for tets, measured in ((1500, 116.5e6), (12_000, 291.8e6), (39_936, 977.0e6)):
        assert abs(estimate([tets], True) / measured - 1) < 0.1
    assert estimate([12_000], False) < estimate([12_000], True)
    assert estimate([6000, 6000], True) < estimate([12_000], True), "two factors of half the size are smaller"


@pytest.mark.parametrize("size", ["much", "4", "1KB", "-4GB", "1e3GB"])
def test_bad_sizes_are_named(size: str) -> None:
    with pytest.raises(InputError, match=f"--max-memory {size}: allowed is a size of at least 80MB"):
        SizeLimits.of_options(None, size)
