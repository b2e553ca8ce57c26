# SPDX-License-Identifier: MIT
"""The benchmark of the models: none left out, its yardstick compiles for GPUs, pieces make one page."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_server.backends import compiler
from sim_server.backends.gpu.device import PRECISIONS, options
from tests.bench.models import __main__ as bench
from tests.bench.models import parts as models
from tests.bench.models import timing
from tests.support import nvrtc


def test_every_model_of_the_registry_is_measured() -> None:
    assert models.missing() == [] and len(models.present()) >= 4


@pytest.mark.parametrize("name", models.present())
def test_launches_of_a_model_fall_into_parts(name: str) -> None:
    made = models.model(name, 540)
    parts = [models.part(launch) for launch in made.launches]
    effects = sum(e.elements is not None for e in made.simulation.effects.values())
    assert parts.count("elements") == effects and parts.count("sums") == 2 * effects
    assert parts.count("rest") in (3, 4) and effects == (2 if "and" in name else 1)
    rest = made.simulation.world.rest
    for x, v in models.states(rest, 3).values():
        made.put(x, v)
        for launch in made.launches:
            launch()
        assert np.isfinite(made.simulation.matrix().data).all()
        assert np.isfinite(made.simulation.system.b).all() and np.abs(made.simulation.system.b).max() > 0


def test_bytes_count_an_array_once_a_kernel() -> None:
    made = models.model("mass_spring", 540)
    launch = next(x for x in made.launches if models.part(x) == "elements")
    m, n = len(made.effect.elements), made.simulation.world.nodes  # type: ignore[arg-type]
    assert models.megabytes(launch) * 1e6 == m * (8 + 3 * 8 + 4 * 8 + 3 * 8) + n * 2 * 24


@pytest.mark.slow
@pytest.mark.parametrize("law", timing.LAWS)
def test_the_yardstick_compiles_for_gpus(law: str, tmp_path: Path) -> None:
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    text = tmp_path / "generic.cu"
    here = timing.TEXTS
    text.write_text(compiler.read_text(f"{here}generic_elements.cu+{here}generic_{law}.cuh")[1])
    for types in PRECISIONS.values():
        code, said = nvrtc.compiled(library, text, ["-arch=sm_90", *options(types)])
        assert len(code) > 1000 and not said, said


def piece(path: Path, device: str, us: float) -> Path:
    row = {
        "tets": 540, "model": "mass_spring", "device": device, "precision": "float64", "us": us, "elements us": 1.0,
        "sums us": 2.0, "rest us": 3.0, "elements us, stretched": 1.0, "MB": 0.5, "bytes us": 1.5, "us / bytes": 4.0,
    }  # fmt: skip
    data = {"devices": [{"device": device, "what": path.stem, "copy GB/s": 9.0}], "models": [row], "generic": []}
    machine = {"cpu": "fast", "cores": 3, "governor": "none", "load": 0.0, "system": "some"}
    speed = {"dgemm_ms": 1.0, "spmv_ms": 2.0}
    header = {"date": "2026-01-01", "commit": path.stem, "machine": machine, "versions": {"python": "3"}}
    header["calibration"] = {"before": speed, "after": speed}
    path.write_text(json.dumps({"header": header, "arguments": {"devices": [device], "sizes": [540]}, "data": data}))
    return path


def test_pieces_become_one_page(tmp_path: Path) -> None:
    files: list[Any] = [piece(tmp_path / f"{n}.json", d, us) for n, d, us in (("a", "cpu", 7.0), ("b", "gpu", 8.0))]
    bench.merge([*files, piece(tmp_path / "c.json", "cpu", 6.5)], tmp_path / "out")
    text = (tmp_path / "out" / "models.md").read_text()
    assert "## CPU, float64" in text and "## GPU, float64" in text and "| mass_spring | 6.5 | 1 | 2 | 3 |" in text
    assert "| mass_spring | 7 |" not in text and "| cpu | c | 9 |" in text
    assert "commit c" in text and "fast, 3 cores" in text, "the head is that of the last piece"
    assert (tmp_path / "out" / "models.png").read_bytes().startswith(b"\x89PNG")
