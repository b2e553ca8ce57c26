# SPDX-License-Identifier: MIT
"""An effect that a scene does not list is not imported, and nothing of it is compiled or launched."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

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

OBJECT = '[[object]]\nname = "block"\nmesh = { bar = [2, 2, 2], size = [1, 1, 1] }\n[object.effects]\n'
FRAME = {"before": ["nodes.start"], "after": ["nodes.rotate", "rotate_blocks.rotate_blocks", "nodes.advance"]}
ELASTIC = ["corotational.elements", "corotational_nodes.gather", "corotational_blocks.blocks"]
ALWAYS = ["loop.cpp", "nodes.cu", "rotate_blocks.cu"]
ELASTIC_TEXTS = ["corotational.cu", "corotational_blocks.cu", "corotational_nodes.cu"]
COROTATIONAL = "corotational = { young = 1e5, poisson = 0.3 }\n"

SCENES = {
    "nothing at all": ("", "", [], [], []),
    "gravity": ("gravity = true", "", ["gravity"], ["gravity.cu"], ["gravity.gravity"]),
    "gravity switched off": ("gravity = false", "", [], [], []),
    "elastic": ("", COROTATIONAL, ["corotational"], ELASTIC_TEXTS, ELASTIC),
    "fixed only": ("", 'fixed = { where = "X < 0.01" }\n', ["fixed"], [], []),
    "damping of the stiffness alone": (
        "", COROTATIONAL + "rayleigh = { stiffness = 0.1 }\n", ["corotational", "rayleigh"], ELASTIC_TEXTS, ELASTIC,
    ),
    "damping of the mass": (
        "", COROTATIONAL + "rayleigh = { mass = 0.1 }\n", ["corotational", "rayleigh"],
        [*ELASTIC_TEXTS, "rayleigh.cu"], [*ELASTIC, "rayleigh.drag"],
    ),
    "another rotation": (
        "", 'corotational = { young = 1e5, poisson = 0.3, rotation = "qr" }\n', ["corotational"],
        ["corotational_qr.cu", "corotational_blocks.cu", "corotational_nodes.cu"],
        ["corotational_qr.elements", "corotational_nodes.gather", "corotational_blocks.blocks"],
    ),
    "another tangent": (
        "", 'corotational = { young = 1e5, poisson = 0.3, tangent = "exact" }\n', ["corotational"],
        ["corotational.cu", "corotational_exact.cu", "corotational_exact_blocks.cu", "corotational_exact_nodes.cu"],
        ["corotational_exact.elements", "corotational_exact_nodes.gather", "corotational_exact_blocks.blocks"],
    ),
    "springs": (
        "", "mass_spring = { young = 1e5 }\n", ["mass_spring"],
        ["mass_spring.cu", "mass_spring_blocks.cu", "mass_spring_nodes.cu", "shape_matching.cu"],
        ["mass_spring.springs", "mass_spring_nodes.gather", "mass_spring_blocks.blocks", "shape_matching.match"],
    ),
    "a hyperelastic law": (
        "", "neo_hookean = { young = 1e5, poisson = 0.3 }\n", ["neo_hookean"],
        ["gather_blocks.cu", "gather_forces.cu", "neo_hookean.cuh", "shape_matching.cu"],
        ["neo_hookean.elements", "gather_forces.gather", "gather_blocks.gather", "shape_matching.match"],
    ),
    "everything": (
        "gravity = true", COROTATIONAL + 'rayleigh = { mass = 0.1 }\nfixed = { where = "X < 0.01" }\ntouch = true\n',
        ["corotational", "fixed", "gravity", "rayleigh", "touch"],
        [*ELASTIC_TEXTS, "gravity.cu", "rayleigh.cu", "touch.cu"],
        [*ELASTIC, "rayleigh.drag", "touch.apply", "gravity.gravity"],
    ),
}  # fmt: skip


def report(path: Path) -> dict:
    """Two steps of a scene in a process of its own, and what they took."""
    run = subprocess.run([sys.executable, "-c", REPORT, str(path)], capture_output=True, text=True, cwd=ROOT)
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


@pytest.mark.parametrize("case", SCENES.values(), ids=SCENES.keys())
def test_a_scene_pays_for_what_it_lists(case, tmp_path):
    scene, effects, imported, texts, launches = case
    path = tmp_path / "scene.toml"
    path.write_text(f'dt = 0.02\n[effects]\n{scene}\n[solver]\npreconditioner = "block_jacobi"\n{OBJECT}{effects}')
    found = report(path)
    assert found["effects"] == imported
    assert found["compiled"] == sorted([*ALWAYS, *texts])
    assert found["launches"] == FRAME["before"] + launches + FRAME["after"]
    assert found["others"] == []  # a simulation by itself needs no network, log, picture or factorization
