# SPDX-License-Identifier: MIT
"""Scenes with loads are built for a GPU where there is none: texts compile with the options of a run."""

from typing import Any

import pytest

from sim_server.backends.gpu.kernel_fusion import DOMAINS
from sim_server.errors import InputError
from sim_server.simulation import Simulation
from tests.backends import fake_cupy
from tests.effects.hollow import INSIDE, box, hollow
from tests.scenes import scene
from tests.support import nvrtc

pytestmark = pytest.mark.slow
G = (0.0, -9.81, 0.0)
OPEN = {"where": f"{INSIDE} and X > 0.3", "pressure": 3.0, "lids": True}
PATH = [[0, 0, 0], [0.5, 0, 0], [1, 0, 0], [1, 1, 1]]
LOADS: dict[str, tuple[dict[str, Any], set[str]]] = {  # effects of an object, and launches that they have
    "muscle": (
        {"muscle": {"stress": 1e4, "direction": [1, 0, 0], "period": 0.5}}, {"muscle.elements", "muscle_load.load"},
    ),
    "cavity": (
        {"cavity": [{"where": INSIDE, "pressure": 9.0}, OPEN]},
        {f"cavity.{name}" for name in ("lids", "walls", "chunks", "slopes", "pressures", "load")},
    ),
    "cable": (
        {"cable": [{"path": PATH, "tension": 9.0}, {"path": PATH[::2], "stiffness": 1e3, "shortening": 0.1}]},
        {"cable.segments", "cable.tensions", "cable.guides"},
    ),
    "growth": ({"growth": {"expansion": 1e-3, "amount": 10.0}}, set()),
    "wind": ({"wind": {"velocity": [3, 0, 0]}}, {"wind.faces"}),
    "buoyancy": ({"buoyancy": {"level": 0.3}}, {"buoyancy.wetted", "buoyancy.lift"}),
    "rod": (
        {"rod": {"path": [[0.1, 0.1, 0.1], [0.9, 0.15, 0.1]], "young": 1e8, "radius": 0.01, "density": 7850.0}},
        {"rod.springs", "rod_sums.nodes"},
    ),
    "membrane": ({"membrane": {"young": 1e6, "poisson": 0.4, "thickness": 0.01}}, {"membrane.elements"}),
    "target": ({"target": {"to": ["X", "Y + 0.2 * X", "Z"], "stiffness": 1e3}}, {"target.tie"}),
}  # fmt: skip
SCHEMES = [("backward_euler", "mixed"), ("ros2", "float64"), ("central_difference", "float32")]


@pytest.fixture(autouse=True)
def cupy(tmp_path, monkeypatch):
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    with fake_cupy.installed(tmp_path, library, monkeypatch) as fake:
        yield fake


@pytest.mark.parametrize(("scheme", "precision"), SCHEMES)
def test_loads_are_built(cupy, tmp_path, scheme, precision):
    """All of them in one scene, whose launches join the kernels over elements, nodes and blocks."""
    loads = {name: params for effects, _ in LOADS.values() for name, params in effects.items()}
    loads |= {"traction": {"where": "X > 0.99", "pressure": 2.0}, "fixed": {"where": "X < 0.01"}}
    given = hollow(tmp_path, loads.pop("cavity"), box(), **loads)
    sim = Simulation(scene(given, integrator={"scheme": scheme}, gravity=G, precision=precision), "gpu")
    assert "report_measured" in [kernel for kernel, _ in cupy.calls]
    sim.engine.run(3)
    assert sim.engine.step == 3
    sim.engine.records()
    assert sim.engine.readings.shape == (3, 8)  # two of each cavity and cable
    names = {x.name for x in sim.step_launches}
    assert {"traction.load"}.union(*(launches for _, launches in LOADS.values())) <= names
    assert all(x.domain in DOMAINS for x in sim.step_launches if x.name in names and x.name.split(".")[0] in LOADS)


@pytest.mark.parametrize("cavity", [{"amount": 1.0}, {"volume": 0.1, "bulk": 1e5}])
def test_what_changes_with_the_volume_is_refused(cupy, tmp_path, cavity):
    with pytest.raises(InputError, match="on a CPU alone"):
        Simulation(scene(hollow(tmp_path, {"where": INSIDE} | cavity)), "gpu")
