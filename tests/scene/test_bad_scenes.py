# SPDX-License-Identifier: MIT
# ruff: noqa: E501 (one row per malformed scene reads better than wrapped rows)
"""Malformed scenes: every message names the file, the object, the key, the value and what is allowed."""

import re

import meshio
import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.scene import load

GOOD = """\
dt = 0.02
[effects]
gravity = true
[solver]
tolerance = 1e-6
[[object]]
name = "beam"
mesh = { bar = [2, 1, 1], size = [2, 1, 1] }
density = 1000
[object.effects]
corotational = { young = 5e5, poisson = 0.4 }
fixed = { where = "X < 0.01" }
"""
SECOND = '[[object]]\nname = "beam"\nmesh = { bar = [1, 1, 1], size = [1, 1, 1] }\n'


def message(tmp_path, text):
    path = tmp_path / "beam.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError) as error:
        load(path)
    return str(error.value)


def swap(old, new):
    assert old in GOOD
    return GOOD.replace(old, new)


def test_the_unchanged_scene_is_good(tmp_path):
    path = tmp_path / "beam.toml"
    path.write_text(GOOD)
    assert load(path).objects[0].name == "beam"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (swap("poisson = 0.4", "poisson = 0.5"), "object 'beam', effects.corotational.poisson = 0.5: must be less than 0.5"),
        (swap("poisson = 0.4", "poisson = -1"), "poisson = -1: must be greater than -1"),
        (swap("corotational =", "neo_hookean =").replace("0.4", "-0.1"), "effects.neo_hookean.poisson = -0.1: must be 0 or more: below"),
        (swap(", poisson = 0.4", ""), "effects.corotational.poisson: missing"),
        (swap("young = 5e5, poisson = 0.4", 'young = [{ where = "X < 1", young = 1, poisson = 0.1 }, { young = 1 }]'), "effects.corotational.poisson: missing"),
        (swap("corotational = { young = 5e5, poisson = 0.4", "mooney_rivlin = { c1 = [{ c1 = 1, bulk = 1 }]"), "effects.mooney_rivlin.c2: missing"),
        (swap("fixed =", "fibres = { stiffness = 1, direction = [1, 0, 0], floor = 0.1 }\nfixed ="), "effects.fibres.floor = 0.1: unknown key (known keys: direction, exponent, stiffness)"),
        (swap("fixed =", 'fibres = { stiffness = 1, direction = [1, 0, 0], inversion = "refuse" }\nfixed ='), "effects.fibres.inversion = 'refuse': unknown key"),
        (swap("young = 5e5", "young = 0"), "effects.corotational.young = 0: must be greater than 0"),
        (swap("young = 5e5", 'young = "5e5"'), "effects.corotational.young = '5e5': must be a number"),
        (swap("young = 5e5", "young = true"), "effects.corotational.young = true: must be a number"),
        (swap("young = 5e5, ", ""), "effects.corotational.young: missing"),
        (swap("young = 5e5", "young = []"), "must have at least one region"),
        (swap("young = 5e5", "young = [{ young = 1 }, { young = 2 }]"), "region 1 has no where"),
        (swap("young = 5e5", 'young = [{ where = "X", young = 1 }]'), "corotational.young[1].where = 'X': 'X' must be a"),
        (swap("young = 5e5", 'young = [{ where = "X<1", yung = 1 }]'), "young[1].yung = 1: unknown key; did you mean 'young'"),
        (swap("young = 5e5", "young = [3]"), "corotational.young[1] = 3: must be"),
        (swap("poisson = 0.4", 'poisson = 0.4, rotation = "svd"'), "corotational.rotation = 'svd': must be 'polar' or 'qr'"),
        (swap("poisson = 0.4", 'poisson = 0.4, rotation = "qr", tangent = "exact"'), 'tangent = "exact" needs rotation = "polar"'),
        (swap("fixed =", "mass_spring = { young = 1e5, poisson = 0.3 }\nfixed ="), "effects.mass_spring: poisson is not accepted: springs pull along the line between two nodes"),
        (swap("fixed =", "mass_spring = { young = [{ young = 1e5, poisson = 0.3 }] }\nfixed ="), "mass_spring: poisson is not accepted"),
        (swap("fixed =", "mass_spring = true\nfixed ="), "mass_spring: needs either young (springs on the edges of the elements) or springs"),
        (swap("fixed =", "mass_spring = { springs = [[0, 1]] }\nfixed ="), "mass_spring: listed springs need their stiffness [N/m]"),
        (swap("fixed =", "mass_spring = { young = 1e5, stiffness = 3 }\nfixed ="), "stiffness and rest_length belong to listed springs"),
        (swap("fixed =", "mass_spring = { springs = [[0, 1, 2]], stiffness = 1 }\nfixed ="), "mass_spring.springs[1] = (0, 1, 2): must have at most 2 items"),
        (swap("fixed =", 'mass_spring = { springs = "absent.txt", stiffness = 1 }\nfixed ='), "absent.txt'); a relative path starts at the folder of the scene file"),
        (swap('"X < 0.01"', '"x < 0.01"'), "effects.fixed.where = 'x < 0.01': unknown name 'x' (write X); allowed: the rest"),
        (swap('{ where = "X < 0.01" }', "true"), "effects.fixed.where: missing"),
        (swap('{ where = "X < 0.01" }', "3"), "effects.fixed = 3: must be a table of parameters, true"),
        (swap("corotational", "corotated"), "effects.corotated: no such effect; did you mean 'corotational'? (known effects: "),
        (swap("fixed =", '"../fixed" ='), "effects.../fixed: no such effect"),
        (swap("fixed =", "__init__ ="), "effects.__init__: no such effect"),
        (swap("gravity = true", "gravty = true"), "beam.toml, effects.gravty = true: no such effect; did you mean 'gravity'"),
        (swap("gravity = true", 'fixed = { where = "true" }'), "effects.fixed: effect 'fixed' does not belong here; it acts on one object: list it under [object.effects]"),
        (GOOD + "gravity = true\n", "object 'beam', effects.gravity = true: effect 'gravity' does not belong here; it acts on the whole scene"),
        (swap("gravity = true", "gravity = { g = [0, 1] }"), "effects.gravity.g[3]: missing"),
        (swap("gravity = true", "gravity = { g = [0, nan, 0] }"), "effects.gravity.g[2] = nan: must be a finite number"),
        (swap("gravity = true", "gravity = { g = 9.81 }"), "effects.gravity.g = 9.81: must be an array"),
        (swap("density = 1000", "[object.effects.rayleigh]\nmass = -1\n").replace("[object.effects]\n", "[object.effects.touch]\nmax_interactions = 0\n[object.effects.x]\n"), "effects.rayleigh.mass = -1: must be greater than or equal to 0"),
        (swap("dt = 0.02", "dt = 0"), "scene beam.toml, dt = 0: must be greater than 0"),
        (swap("dt = 0.02", "dt = -0.02"), "dt = -0.02: must be greater than 0"),
        (swap("dt = 0.02", "dt = inf"), "dt = inf: must be a finite number"),
        (swap("dt = 0.02", "dt = nan"), "dt = nan: must be a finite number"),
        (swap("dt = 0.02", 'dt = "0.02"'), "dt = '0.02': must be a number"),
        (swap("dt = 0.02", ""), "dt: missing"),
        (swap("dt = 0.02", "dt = 0.02\nsovler = {}"), "sovler: unknown key; did you mean 'solver'? (known keys: dt, effects"),
        (swap("tolerance = 1e-6", "tolerance = 1"), "solver.tolerance = 1: must be less than 1"),
        (swap("tolerance = 1e-6", "tolerence = 1"), "solver.tolerence = 1: unknown key; did you mean 'tolerance'"),
        (swap("tolerance = 1e-6", "max_iterations = 0"), "solver.max_iterations = 0: must be greater than or equal to 1"),
        (swap("tolerance = 1e-6", "max_iterations = 5.5"), "max_iterations = 5.5: must be a whole number"),
        (swap("tolerance = 1e-6", "omega = 2"), "solver.omega = 2: must be less than 2"),
        (swap("tolerance = 1e-6", "omega = 0"), "solver.omega = 0: must be greater than 0"),
        (swap("tolerance = 1e-6", "drop_tolerance = 1"), "solver.drop_tolerance = 1: must be less than 1"),
        (swap("tolerance = 1e-6", "fill = -1"), "solver.fill = -1: must be greater than or equal to 0"),
        (swap("tolerance = 1e-6", 'schedule = "fair"'), "solver.schedule = 'fair': must be 'excess' or 'round_robin'"),
        (swap("tolerance = 1e-6", "schedule_rounds = 0.5"), "solver.schedule_rounds = 0.5: must be greater than or equal to 1"),
        (swap("tolerance = 1e-6", 'preconditioner = "ilu"'), "preconditioner = 'ilu': must be one of auto, none, jacobi"),
        (swap("tolerance = 1e-6", 'warp = "true"'), "solver.warp = 'true': must be true or false"),
        (swap("tolerance = 1e-6", "warp = 1"), "solver.warp = 1: must be true or false"),
        (swap("tolerance = 1e-6", 'update = "every-0"'), 'solver.update = \'every-0\': must be "never", "async", "adaptive", "every-N"'),
        (swap("tolerance = 1e-6", 'update = "lockstep"'), "solver.update = 'lockstep'"),
        (swap("tolerance = 1e-6", 'factor_precision = "half"'), "factor_precision = 'half': must be 'auto', 'float16', 'float32' or 'float64'"),
        (swap("tolerance = 1e-6", "warm_start = 1"), "solver.warm_start = 1: must be true or false"),
        (swap("tolerance = 1e-6", "budget = -1"), "solver.budget = -1: must be greater than or equal to 0"),
        (swap("[solver]", "[record]\nevery = 0\n[solver]"), "record.every = 0: must be greater than or equal to 1"),
        (swap("[solver]", '[record]\ncompression = "gz"\n[solver]'), "compression = 'gz': must be 'lz4', 'zstd' or 'none'"),
        (swap("[solver]\ntolerance = 1e-6", "solver = 3").replace("[effects]\ngravity = true\n", ""), "solver = 3: must be a table"),
        (swap("density = 1000", "density = 1\nmass = 2"), "object 'beam': give density or mass, not both (density = 1, mass = 2)"),
        (swap("density = 1000", 'masses = "all"'), "object 'beam', masses = 'all': must be 'volume' or 'equal'"),
        (swap("density = 1000", "pose = { rotate = [0, 0] }"), "object 'beam', pose.rotate[3]: missing"),
        (swap("density = 1000", "pose = { rotate = [0, 0, 0, 0] }"), "pose.rotate = (0, 0, 0, 0): must have at most 3 items"),
        (swap("density = 1000", "position = [0, 0, 0]"), "object 'beam', position = [0, 0, 0]: unknown key"),
        (swap("bar = [2, 1, 1]", "bar = [2, 0, 1]"), "object 'beam', mesh.bar[2] = 0: must be greater than or equal to 1"),
        (swap("size = [2, 1, 1]", "size = [2, -1, 1]"), "mesh.size[2] = -1: must be greater than 0"),
        (swap(", size = [2, 1, 1]", ""), "object 'beam', mesh: must be { bar = [nx, ny, nz], size = [sx, sy, sz] } or { file"),
        (swap("bar = [2, 1, 1], size = [2, 1, 1]", 'file = "liver.msh"'), "mesh.file = 'liver.msh': no such file ("),
        (swap("bar = [2, 1, 1], size = [2, 1, 1]", f'file = "{"b" * 5000}"'), "bbb...: no such file ("),
        (swap("bar = [2, 1, 1], size = [2, 1, 1]", 'file = "a\\u0000b"'), "mesh.file = 'a\\x00b': no such file ("),
        (swap('mesh = { bar = [2, 1, 1], size = [2, 1, 1] }', ""), "object 'beam', mesh: missing"),
        (swap('name = "beam"', ""), "object 1, name: missing"),
        (swap('name = "beam"', 'name = "my beam"'), "object 'my beam', name = 'my beam': must be 1 to 64 characters"),
        (swap('name = "beam"', 'name = "a/b"'), "name = 'a/b': must be 1 to 64 characters of A-Z"),
        (swap('name = "beam"', 'name = "beam\\n"'), "name = 'beam\\n': must be"),
        (swap('name = "beam"', 'name = ""'), "object 1, name = '': must be 1 to 64"),
        (swap('name = "beam"', f'name = "{"b" * 65}"'), "must be 1 to 64 characters"),
        (swap('name = "beam"', "name = 7"), "object 1, name = 7: must be a string"),
        (GOOD + SECOND, "object: names must differ; more than once: beam"),
        ("dt = 0.02\n", "scene beam.toml, object: a scene needs at least one [[object]]"),
        ("dt = 0.02\nobject = []\n", "object: a scene needs at least one [[object]]"),
        ("dt = 0.02\n[object]\nname = 'a'\n", "object: write [[object]] with double brackets, once per object"),
        ("dt = 0.02\nobject = [3]\n", "object 1 = 3: must be a table"),
        ("dt = 0.02\nobject = 3\n", "object: must be an array"),
        ("dt = 0.02\nname beam\n", "not valid TOML"),
        ("dt = 0.02\nname = beam\n", "at line 2, column 8"),
        ("dt = 0.02\ndt = 0.03\n", "at line 2"),
        (b"dt = 0.02 # \xff\n", "not a text file in UTF-8 (byte 12)"),
    ],
)  # fmt: skip
def test_malformed_scene(tmp_path, text, words):
    found = message(tmp_path, text)
    assert words in found, found
    assert all(re.match(r"scene \S*beam\.toml[,:] ", line) for line in found.splitlines())


def test_all_errors_at_once(tmp_path):
    text = swap("poisson = 0.4", "poisson = 0.5").replace("dt = 0.02", "dt = 0").replace("tolerance", "tolerence")
    lines = message(tmp_path, text + "touch = { max_force = 0 }\n" + SECOND.replace("bar", "bra")).splitlines()
    places = ["dt = 0", "solver.tolerence", "corotational.poisson = 0.5", "touch.max_force = 0", "mesh.bra"]
    assert len(lines) == len(places)
    assert all(any(place in line for line in lines) for place in places)


def test_long_values_are_cut(tmp_path):
    found = message(tmp_path, swap("tolerance = 1e-6", f'update = "{"x" * 5000}"'))
    assert len(found) < 400 and "xxx..." in found


def test_missing_scene_and_folder(tmp_path):
    for path in (str(tmp_path / "absent.toml"), str(tmp_path), "null\0byte.toml", "long" * 999):
        with pytest.raises(InputError, match=re.escape(f"scene {path!r}: cannot be read (")):
            load(path)


def test_mesh_files_are_found_beside_the_scene_and_checked(tmp_path, monkeypatch):
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]])
    tet = np.array([[0, 2, 1, 3]])  # inverted
    (tmp_path / "scenes" / "meshes").mkdir(parents=True)
    meshio.write(tmp_path / "scenes" / "meshes" / "good.vtk", meshio.Mesh(corners[:4], [("tetra", tet)]))
    meshio.write(
        tmp_path / "scenes" / "meshes" / "flat.vtk", meshio.Mesh(corners, [("tetra", np.array([[0, 1, 2, 4]]))])
    )
    path = tmp_path / "scenes" / "file.toml"
    path.write_text(swap("bar = [2, 1, 1], size = [2, 1, 1]", 'file = "meshes/good.vtk"'))
    monkeypatch.chdir(tmp_path)
    scene = load("scenes/file.toml")
    assert scene.objects[0].load_mesh().tets.tolist() == [[0, 2, 3, 1]]
    assert scene.resolved()["object"][0]["mesh"] == {"file": str(tmp_path / "scenes" / "meshes" / "good.vtk")}
    with pytest.raises(InputError, match=r"object 'beam': mesh flat.vtk: tet 0 .*zero volume"):
        load(path, ["object.beam.mesh.file=meshes/flat.vtk"]).objects[0].load_mesh()
