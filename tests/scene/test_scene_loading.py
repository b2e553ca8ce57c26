# SPDX-License-Identifier: MIT
"""Good scenes: the documented sample, defaults, overrides, and that only listed effects are imported."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from sim_server.effects import known_effects
from sim_server.errors import InputError
from sim_server.scene import load
from sim_server.scene.solver_options import Update

SCENES = Path(__file__).parents[2] / "deploy" / "scenes"

SAMPLE = (Path(__file__).parent / "sample.toml").read_text()  # as in the documentation
SMALLEST = 'dt = 0.01\n[[object]]\nname = "a"\nmesh = { bar = [1, 1, 1], size = [1, 1, 1] }\n'


@pytest.fixture
def sample(tmp_path):
    path = tmp_path / "sample.toml"
    path.write_text(SAMPLE)
    return path


def test_the_documented_sample(sample):
    scene = load(sample)
    assert (scene.dt, scene.name, scene.path, scene.text) == (0.02, "sample", sample, SAMPLE)
    assert list(scene.effects) == ["gravity"] and scene.effects["gravity"].g == (0.0, -9.81, 0.0)
    assert scene.solver.preconditioner == "cholesky" and scene.solver.update == Update("async", 0)
    (beam,) = scene.objects
    assert list(beam.effects) == ["corotational", "rayleigh", "fixed"]
    assert beam.effects["corotational"].young == 5e5 and beam.effects["fixed"].where == "X < 0.01"
    assert beam.pose.rotate == (40.0, 0.0, 70.0) and (beam.density, beam.mass) == (1000.0, None)
    mesh = beam.load_mesh()
    assert mesh.rest.max(axis=0) == pytest.approx([10, 2, 2]) and len(mesh.tets) == 3000


def test_defaults_and_resolved(tmp_path):
    path = tmp_path / "small.toml"
    path.write_text(SMALLEST)
    assert load(path).resolved() == {
        "dt": 0.01,
        "name": "small",
        "effects": {},
        "integrator": {
            "scheme": "backward_euler",
            "linearizations": 1,
            "tolerance": 1e-4,
            "trials": 8,
            "solve": "auto",
        },
        "solver": {
            "tolerance": 1e-6,
            "max_iterations": 500,
            "preconditioner": "auto",
            "omega": 1.0,
            "drop_tolerance": 0.003,
            "fill": 10.0,
            "warp": True,
            "warp_level": 1,
            "projection": "auto",
            "update": "async",
            "precision": "float64",
            "factor_precision": "auto",
            "budget": 0.0,
            "on_runaway": "freeze",
            "threads": 1,
            "gpus": 1,
            "warm_start": True,
            "woodbury": 32,
            "build": "server",
            "extrapolate": 0.0,
            "update_floor_iterations": 3,
            "update_floor_steps": 1,
            "update_threshold": 1.0,
            "schedule": "excess",
            "schedule_rounds": 8.0,
        },
        "record": {"every": 1, "compression": "lz4"},
        "object": [
            {
                "name": "a",
                "mesh": {"bar": [1, 1, 1], "size": [1.0, 1.0, 1.0], "split": "mirrored"},
                "pose": {"rotate": [0.0, 0.0, 0.0], "translate": [0.0, 0.0, 0.0]},
                "density": 1000.0,
                "masses": "volume",
                "elements": "auto",
                "effects": {},
            }
        ],
    }


@pytest.mark.parametrize(
    ("text", "update"),
    [
        ("never", ("never", 0)),
        ("async", ("async", 0)),
        ("adaptive", ("adaptive", 0)),
        ("every-30", ("every", 30)),
        ("lockstep-3", ("lockstep", 3)),
    ],
)
def test_update_is_parsed_and_resolved_back(sample, text, update):
    scene = load(sample, [f"solver.update={text}"])
    assert scene.solver.update == update and scene.resolved()["solver"]["update"] == text


@pytest.mark.parametrize(
    ("override", "read"),
    [
        ("dt=0.01", lambda s: s.dt == 0.01),
        ("dt = 1", lambda s: s.dt == 1.0),
        ("name=other", lambda s: s.name == "other"),
        ("solver.tolerance=1e-8", lambda s: s.solver.tolerance == 1e-8),
        ("solver.warp=false", lambda s: s.solver.warp is False),
        ('solver.preconditioner="none"', lambda s: s.solver.preconditioner == "none"),
        ("record.every=5", lambda s: s.record.every == 5),
        ("effects.gravity.g=[0, 0, -1]", lambda s: s.effects["gravity"].g == (0.0, 0.0, -1.0)),
        ("effects.gravity=false", lambda s: s.effects == {}),
        ("object.beam.density=900", lambda s: s.objects[0].density == 900.0),
        ("object.beam.effects.corotational.young=1e6", lambda s: s.objects[0].effects["corotational"].young == 1e6),
        ("object.beam.effects.fixed.where=X < 3 and Y >= 1", lambda s: "Y >= 1" in s.objects[0].effects["fixed"].where),
        ("object.beam.effects.touch=true", lambda s: s.objects[0].effects["touch"].max_interactions == 16),
        ("object.beam.effects.touch.max_force=5", lambda s: s.objects[0].effects["touch"].max_force == 5.0),
        ("object.beam.mesh={ bar = [1, 2, 3], size = [1, 1, 1] }", lambda s: s.objects[0].mesh.bar == (1, 2, 3)),
    ],
)
def test_overrides(sample, override, read):
    scene = load(sample, [override])
    assert read(scene)
    assert scene.resolved() != load(sample).resolved()


def test_overrides_of_names_with_dots_and_in_order(tmp_path):
    path = tmp_path / "dots.toml"
    block = '[[object]]\nname = "{}"\nmesh = {{ bar = [1, 1, 1], size = [1, 1, 1] }}\n'
    path.write_text("dt = 0.1\n" + block.format("a") + block.format("a.density"))
    scene = load(path, ["object.a.density.density=7", "object.a.density=8", "object.a.density=9"])
    assert [o.density for o in scene.objects] == [9.0, 7.0]


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("solver.tolerence=1e-8", ["solver.tolerence = 1e-08", "unknown key", "did you mean 'tolerance'"]),
        ("solvr.tolerance=1e-8", ["solvr: unknown key", "did you mean 'solver'?"]),
        ("solver.tolerance=small", ["solver.tolerance = 'small'", "must be a number"]),
        ("dt=-1", ["dt = -1", "greater than 0"]),
        ("dt", ["override 'dt'", "KEY=VALUE"]),
        ("=3", ["KEY=VALUE"]),
        ("solver..tolerance=3", ["KEY=VALUE"]),
        ("dt.x=3", ["dt = 0.02 is no table"]),
        ("object=3", ["no object"]),
        ("object.beam=3", ["no object 'beam' with a key after it", "known objects: beam"]),
        ("object.baem.density=3", ["no object 'baem'", "did you mean 'beam'?"]),
        ("object.beam.densty=3", ["object 'beam', densty = 3", "did you mean 'density'?"]),
        ("object.beam.effects.toch=true", ["effects.toch = true", "no such effect", "did you mean 'touch'?"]),
        ("object.beam.pose.rotate=[1, 2", ["'[1, 2' is not valid TOML"]),
        ("dt=", ["'' is not valid TOML"]),
        ("dt=1\nx=2", ["dt = '1\\nx=2'", "must be a number"]),
    ],
)
def test_wrong_overrides(sample, override, words):
    with pytest.raises(InputError) as error:
        load(sample, [override])
    assert all(w in str(error.value) for w in ["scene sample.toml", *words]), str(error.value)


def imported_by(program):
    """Effect modules in sys.modules of a fresh interpreter after `program`."""
    report = (
        "\nimport json, sys\n"
        "prefix = 'sim_server.effects.'\n"
        "names = sorted(m[len(prefix):] for m in sys.modules if m.startswith(prefix))\n"
        "print(json.dumps([name for name in names if not name.startswith('_')]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program + report],
        capture_output=True,
        text=True,
        check=True,
        cwd=Path(__file__).parents[2],
    )
    return json.loads(done.stdout)


def test_only_listed_effects_are_imported(sample, tmp_path):
    small = tmp_path / "small.toml"
    small.write_text(SMALLEST)
    load_it = "from sim_server.scene import load; load({!r}, {!r})"
    assert imported_by(load_it.format(str(small), [])) == []
    assert imported_by(load_it.format(str(small), ["effects.gravity=true", "object.a.effects.touch=false"])) == [
        "gravity"
    ]
    assert imported_by(load_it.format(str(sample), [])) == ["corotational", "fixed", "gravity", "rayleigh"]


def test_loading_a_bar_imports_no_heavy_library(sample):
    program = f"from sim_server.scene import load; load({str(sample)!r}).objects[0].load_mesh(); import sys\n"
    imported_by(program + "assert not {'meshio', 'scipy', 'zenoh', 'cupy', 'matplotlib'} & set(sys.modules)")


def test_a_server_begins_without_scipy(sample):
    """Its import would be a fifth of the start of a server."""
    program = "from sim_server.service import scene_notes, service; from sim_server.simulation import Simulation; "
    program += f"scene_notes.scene_notes(Simulation.load({str(sample)!r})); import sys\n"
    imported_by(program + "assert not {'meshio', 'scipy', 'cupy', 'matplotlib'} & set(sys.modules)")


def test_the_folder_is_the_registry():
    assert {"corotational", "fixed", "gravity", "rayleigh", "touch"} <= set(known_effects())
    assert "__init__" not in known_effects()


@pytest.mark.parametrize(
    ("name", "elements"),
    [
        ("beam", [3000]),
        ("sofa_beam", [3000]),
        ("heterogeneous", [3150]),
        ("four_beams", [3000] * 4),
        ("posed", [3000]),
        ("fibres", [648]),
        ("springs", [768, 12]),
        ("vibration", [864]),
        ("equilibrium", [768]),
        ("floor_drop", [1536]),
        ("incline", [648] * 2),
        ("stairs", [1728]),
        ("gripper", [1296]),
        ("tool_on_organ", [2304]),
        ("two_organs", [864, 972]),
        ("needle_holder", [1728]),
        ("graft", [972, 648]),
        ("needle", [3600, 72]),
        ("soft_gripper", [1344] * 3),
        ("heap", [180] * 12),
        ("pile", [540] * 50),
    ],
)
def test_shipped_scenes(name, elements):
    scene = load(SCENES / f"{name}.toml")
    assert [len(o.load_mesh().tets) for o in scene.objects] == elements
    assert scene.name == name and "gravity" in scene.effects


def test_shipped_scenes_resolve_to_scenes():
    """`resolved()` loses nothing: validated again, also after JSON, it gives the same scene."""
    paths = sorted(SCENES.glob("*.toml"))
    assert len(paths) >= 9
    for path in paths:
        scene = load(path)
        again = type(scene).model_validate(json.loads(json.dumps(scene.resolved())))
        assert again.resolved() == scene.resolved()
        assert (again.solver, again.objects, again.effects) == (scene.solver, scene.objects, scene.effects)
