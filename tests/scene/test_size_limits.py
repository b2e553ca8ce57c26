# SPDX-License-Identifier: MIT
"""`--max-objects`, `--max-memory`: scenes that are too large are refused before anything is allocated."""

import subprocess
import sys
from pathlib import Path

import pytest

from precond_worker.factorization.factorize import Analysis
from sim_server import backends
from sim_server.errors import InputError
from sim_server.scene import load
from sim_server.scene.size_limits import Size, SizeLimits, estimate, values
from sim_server.simulation import Simulation

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
        SizeLimits(None, 126.1e6).check(load(path))


MEASURED = [  # largest resident memory of servers with a log [bytes]: bars, solves with factors or without
    ((5, 5, 10), "linear", True, 134.0e6),
    ((10, 10, 20), "linear", True, 208.8e6),
    ((16, 16, 26), "linear", True, 434.7e6),
    ((28, 28, 43), "linear", True, 1701.3e6),
    ((5, 5, 10), "quadratic", True, 236.0e6),
    ((10, 10, 20), "quadratic", True, 1024.9e6),
    ((10, 10, 20), "patch", True, 256.3e6),
    ((16, 16, 26), "patch", True, 600.0e6),
    ((10, 10, 20), "smoothed", True, 323.5e6),
    ((16, 16, 26), "smoothed", True, 964.7e6),
    ((16, 16, 26), "patch", False, 259.1e6),
    ((10, 10, 20), "smoothed", False, 195.2e6),
    ((16, 16, 26), "smoothed", False, 357.7e6),
    ((16, 16, 26), "linear", False, 185.3e6),
    ((28, 28, 43), "linear", False, 467.5e6),
]


@pytest.mark.parametrize(("cells", "elements", "factors", "measured"), MEASURED)
def test_the_estimate_is_near_what_was_measured(
    cells: tuple[int, int, int], elements: str, factors: bool, measured: float, tmp_path: Path
) -> None:
    """The scene passes with a sixth more than was measured, and is refused with a sixth less."""
    path = scene(tmp_path, list(cells))
    solver = f'elements = "{elements}"\n[object.effects]'
    text = path.read_text().replace("[object.effects]", solver)
    preconditioner = "cholesky" if factors else "block_jacobi"
    path.write_text(text.replace("[[object]]", f'[solver]\npreconditioner = "{preconditioner}"\n[[object]]', 1))
    SizeLimits(None, measured * 7 / 6).check(load(path))
    with pytest.raises(InputError, match="--max-memory allows"):
        SizeLimits(None, measured * 5 / 6).check(load(path))


@pytest.mark.parametrize(("factors", "spares", "measured"), [(False, 2000, 164.4e6), (True, 20_000, 297.8e6)])
def test_spare_nodes_are_counted(factors: bool, spares: int, measured: float) -> None:
    """Of the bar of 12,000 tets, as above."""
    size = Size(12_000, 2541)
    assert estimate([size._replace(spares=spares)], factors) == pytest.approx(measured, rel=1 / 6)
    assert estimate([size], factors) < estimate([size._replace(spares=spares)], factors)


@pytest.mark.parametrize(("kind", "cells"), [("linear", 20), ("patch", 20), ("smoothed", 20), ("quadratic", 10)])
def test_factors_have_about_as_many_values_as_is_told(kind: str, cells: int, tmp_path: Path) -> None:
    """Real ones of bars of 2,541 nodes: never more; bars with many more nodes have up to 1.7 times as many for it."""
    given = load(scene(tmp_path, [cells // 2, cells // 2, cells]), [CHOLESKY[1].format(kind)])
    system = Simulation(given).system
    nodes = len(system.row_start) - 1
    found = Analysis(system.row_start, system.columns).pattern.nonzeros
    assert found <= values(Size(0, nodes, len(system.columns), kind)) <= 1.75 * found


def test_factors_of_large_bodies_are_not_counted_in_shared_memory() -> None:
    """A million tets: three copies of L, 2.9 GB each, and the rest."""
    assert 9e9 < estimate([Size(1_029_000, 182_736)], True) < 12e9


def test_two_factors_of_half_the_size_are_smaller() -> None:
    half, whole = Size(6000, 1300), Size(12_000, 2600)
    assert estimate([whole], False) == estimate([half, half], False) < estimate([half, half], True)
    assert estimate([half, half], True) < estimate([whole], True)


CHOLESKY = ["solver.preconditioner='cholesky'", "object.o0.elements='{}'"]


@pytest.mark.parametrize("kind", ["linear", "patch", "smoothed", "quadratic"])
def test_blocks_of_matrices_are_near_those_that_there_are(kind: str, tmp_path: Path) -> None:
    """Of a small bar, whose nodes at the surface have fewer neighbours: up to a third more."""
    given = load(scene(tmp_path, [6, 6, 8]), [CHOLESKY[1].format(kind)])
    blocks = len(Simulation(given).system.columns)
    told: list[float] = []
    SizeLimits(None, 1e12).check(
        given.model_copy(update={"solver": load(given.path, CHOLESKY[:1]).solver}),
        lambda counts: told.extend(counts) or 0.0,
    )
    assert len(told) == 1 and blocks <= told[0] <= 1.34 * blocks


@pytest.mark.parametrize("spares", [20, 5000])
def test_room_for_blocks_of_spare_nodes_is_counted(spares: int, tmp_path: Path) -> None:
    path, told = scene(tmp_path, [6, 6, 8]), list[float]()
    path.write_text(path.read_text() + f"cutting = {{ spare = {spares} }}\n")
    room = len(Simulation(load(path)).system.columns)
    SizeLimits(None, 1e12).check(load(path, CHOLESKY[:1]), lambda counts: told.extend(counts) or 0.0)
    assert room <= told[0] <= 1.34 * room


def test_copies_of_matrices_of_a_gpu_are_counted() -> None:
    """Two places for each matrix while all of them have half a GiB, else one, in the type of the device."""
    mib = 1 << 20
    double, single = (backends.bytes_of_copies("gpu", precision) for precision in ("mixed", "float32"))
    assert backends.bytes_of_copies("cpu", "float64") is None and double is not None and single is not None
    for blocks, mixed, alone in ((mib, 144, 72), (7 * mib, 1008, 504), (8 * mib, 576, 576), (15 * mib, 1080, 540)):
        sizes = [Size(10, 10, blocks // 2)] * 2
        before = estimate(sizes, True)
        assert (estimate(sizes, True, double) - before, estimate(sizes, True, single) - before) == pytest.approx(
            (mixed * mib, alone * mib)
        )
        assert estimate(sizes, False, double) == estimate(sizes, False), "none is copied"


def test_a_scene_that_fits_on_a_cpu_may_not_fit_on_a_gpu(tmp_path: Path) -> None:
    path, limits = scene(tmp_path, [28, 28, 43]), SizeLimits(None, 1.63e9)
    changes = [CHOLESKY[0], CHOLESKY[1].format("linear")]
    limits.check(load(path, changes), backends.bytes_of_copies("cpu", "float64"))
    with pytest.raises(InputError, match="--max-memory allows"):
        Simulation.load(path, changes, "gpu", limits)


@pytest.mark.parametrize("size", ["much", "4", "1KB", "-4GB", "1e3GB"])
def test_bad_sizes_are_named(size: str) -> None:
    with pytest.raises(InputError, match=f"--max-memory {size}: allowed is a size of at least 126MB"):
        SizeLimits.of_options(None, size)
