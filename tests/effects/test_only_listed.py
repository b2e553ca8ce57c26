# SPDX-License-Identifier: MIT
"""An effect that a scene does not list is not imported, and nothing of it is compiled or launched."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from sim_server.effects import known_effects

ROOT = Path(__file__).parents[2]

REPORT = """
import json, sys
from sim_server.backends.compiler import compiled
from sim_server.simulation import Simulation
sim = Simulation.load(sys.argv[1])
sim.engine.run(2)
print(json.dumps({
    "effects": sorted(m.split(".")[-1] for m in sys.modules if m.startswith("sim_server.effects.") and "._" not in m),
    "compiled": sorted(compiled),
    "launches": [launch.name for launch in sim.engine.launches],
    "others": sorted(m for m in sys.modules if m.split(".")[0] in
                     ("cupy", "matplotlib", "meshio", "mcap", "precond_worker", "rerun", "typer", "zenoh", "sksparse")),
}))
"""

OBJECT = (
    '[[object]]\nname = "block"\nmesh = { bar = [2, 2, 2], size = [1, 1, 1] }\nelements = "linear"\n[object.effects]\n'
)
COROTATIONAL = "corotational = { young = 1e5, poisson = 0.3 }\n"

SHARED = ["shape_matching", "gather_forces", "gather_blocks"]  # texts that only some effects need
OTHERS = [*SHARED, "corotational_qr", "corotational_exact"]

SCENES = {  # lines of the scene and of its object, effects listed, texts that run, and others that do not
    "nothing at all": ("", "", [], [], SHARED),
    "gravity": ("gravity = true", "", ["gravity"], ["gravity"], SHARED),
    "gravity switched off": ("gravity = false", "", [], [], SHARED),
    "elastic": ("", COROTATIONAL, ["corotational"], ["corotational"], OTHERS),
    "fixed only": ("", 'fixed = { where = "X < 0.01" }\n', ["fixed"], [], SHARED),
    "damping of the stiffness alone": (
        "", COROTATIONAL + "rayleigh = { stiffness = 0.1 }\n", ["corotational", "rayleigh"], ["corotational"],
        ["rayleigh", *OTHERS],
    ),
    "damping of the mass": (
        "", COROTATIONAL + "rayleigh = { mass = 0.1 }\n", ["corotational", "rayleigh"], ["corotational", "rayleigh"],
        OTHERS,
    ),
    "another rotation": (
        "", 'corotational = { young = 1e5, poisson = 0.3, rotation = "qr" }\n', ["corotational"], ["corotational_qr"],
        ["corotational", "corotational_exact", *SHARED],
    ),
    "another tangent": (
        "", 'corotational = { young = 1e5, poisson = 0.3, tangent = "exact" }\n', ["corotational"],
        ["corotational_exact"], ["corotational_qr", *SHARED],
    ),
    "springs": (
        "", "mass_spring = { young = 1e5 }\n", ["mass_spring"], ["mass_spring", "shape_matching"],
        ["gather_forces", "gather_blocks"],
    ),
    "a hyperelastic law": (
        "", "neo_hookean = { young = 1e5, poisson = 0.3 }\n", ["neo_hookean"],
        ["neo_hookean", "gather_forces", "gather_blocks", "shape_matching"], [],
    ),
    "a memory": (
        "", COROTATIONAL + "prony = { terms = [{ g = 0.5, tau = 0.1 }] }\n", ["corotational", "prony"],
        ["corotational", "prony", "gather_forces", "gather_blocks"], ["shape_matching", "plasticity", "damage"],
    ),
    "contact": (
        'contact = true\n[[obstacle]]\nname = "floor"\nshape = "plane"', COROTATIONAL, ["contact", "corotational"],
        ["contact", "corotational"], ["signed_distance", *OTHERS],
    ),
    "everything but contact": (
        "gravity = true", COROTATIONAL + 'rayleigh = { mass = 0.1 }\nfixed = { where = "X < 0.01" }\ntouch = true\n',
        ["corotational", "fixed", "gravity", "rayleigh", "touch"], ["corotational", "gravity", "rayleigh", "touch"],
        OTHERS,
    ),
}  # fmt: skip


def report(path: Path) -> dict:
    """Two steps of a scene in a process of its own, and what they took."""
    run = subprocess.run([sys.executable, "-c", REPORT, str(path)], capture_output=True, text=True, cwd=ROOT)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


def effect_of(text: str) -> str:
    """The effect that a text such as corotational_nodes belongs to; "" for one of none."""
    return max((e for e in known_effects() if f"{text}_".startswith(f"{e}_")), key=len, default="")


@pytest.mark.parametrize("case", SCENES.values(), ids=SCENES.keys())
def test_a_scene_pays_for_what_it_lists(case, tmp_path):
    scene, effects, listed, runs, idle = case
    path = tmp_path / "scene.toml"
    path.write_text(f'dt = 0.02\n[effects]\n{scene}\n[solver]\npreconditioner = "block_jacobi"\n{OBJECT}{effects}')
    found = report(path)
    assert found["effects"] == listed
    compiled = {Path(name).stem for name in found["compiled"]}
    launched = {launch.split(".")[0] for launch in found["launches"]}
    assert launched and launched < compiled
    assert {effect_of(name) for name in compiled} <= {"", *listed}
    assert set(runs) <= compiled and not set(idle) & compiled
    assert set(runs) <= launched and not set(idle) & launched
    assert found["others"] == []  # a simulation by itself needs no network, log, picture or factorization
