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


def test_what_is_wrong_with_several_keys_names_them_and_no_place(tmp_path):
    said = message(tmp_path, swap("tolerance = 1e-6", "budget = 1\nbudget_ms = 2"))
    assert said == "scene beam.toml: solver.budget_ms = 2 with budget = 1; allowed: one of both"


@pytest.mark.parametrize(
    ("text", "owner", "key", "value", "allowed"),
    [
        (swap("poisson = 0.4", "poisson = 0.5"), "object 'beam'", "effects.corotational.poisson", "0.5", ["0.5"]),
        (swap("poisson = 0.4", "poisson = -1"), "object 'beam'", "effects.corotational.poisson", "-1", ["-1"]),
        (swap("corotational =", "neo_hookean =").replace("0.4", "-0.1"), "object 'beam'", "effects.neo_hookean.poisson", "-0.1", ["0 or more"]),
        (swap(", poisson = 0.4", ""), "object 'beam'", "effects.corotational.poisson", "", ["missing"]),
        (swap("density = 1000", 'elements = "cubic"'), "object 'beam'", "elements", "'cubic'", ["linear", "patch", "smoothed", "quadratic"]),
        (swap("density = 1000", 'elements = "patch"').replace("corotational", "st_venant_kirchhoff"), "object 'beam'", "elements", "'patch'", ["st_venant_kirchhoff", '"linear"']),
        (swap("density = 1000", 'elements = "smoothed"').replace("corotational", "neo_hookean"), "object 'beam'", "elements", "'smoothed'", ["neo_hookean", '"linear"', '"patch"']),
        (swap("density = 1000", 'elements = "quadratic"').replace("corotational", "neo_hookean"), "object 'beam'", "elements", "'quadratic'", ["neo_hookean", '"linear"', '"patch"']),
        (swap("density = 1000", 'elements = "patch"').replace("corotational", "neo_hookean").replace("[solver]\ntolerance = 1e-6", '[integrator]\nscheme = "central_difference"'), "object 'beam'", "elements", "'patch'", ["central_difference", '"linear"']),
        (swap("density = 1000", 'elements = "smoothed"').replace("poisson = 0.4", 'poisson = 0.4, rotation = "qr"'), "object 'beam'", "elements", "'smoothed'", ["qr", '"linear"']),
        (swap("density = 1000", 'elements = "smoothed"').replace("[solver]\ntolerance = 1e-6", '[integrator]\nscheme = "central_difference"'), "object 'beam'", "elements", "'smoothed'", ["central_difference", '"linear"']),
        (swap("density = 1000", 'elements = "patch"').replace("corotational = { young = 5e5, poisson = 0.4 }\n", ""), "object 'beam'", "elements", "'patch'", ["corotational", '"linear"']),
        (swap("young = 5e5, poisson = 0.4", 'young = [{ where = "X < 1", young = 1, poisson = 0.1 }, { young = 1 }]'), "object 'beam'", "effects.corotational.poisson", "", ["missing"]),
        (swap("corotational = { young = 5e5, poisson = 0.4", "mooney_rivlin = { c1 = [{ c1 = 1, bulk = 1 }]"), "object 'beam'", "effects.mooney_rivlin.c2", "", ["missing"]),
        (swap("fixed =", "fibres = { stiffness = 1, direction = [1, 0, 0], floor = 0.1 }\nfixed ="), "object 'beam'", "effects.fibres.floor", "0.1", ["unknown", "direction", "exponent", "stiffness"]),
        (swap("fixed =", 'fibres = { stiffness = 1, direction = [1, 0, 0], inversion = "refuse" }\nfixed ='), "object 'beam'", "effects.fibres.inversion", "'refuse'", ["unknown", "stiffness"]),
        (swap("young = 5e5", "young = 0"), "object 'beam'", "effects.corotational.young", "0", ["0"]),
        (swap("young = 5e5", 'young = "5e5"'), "object 'beam'", "effects.corotational.young", "'5e5'", ["number"]),
        (swap("young = 5e5", "young = true"), "object 'beam'", "effects.corotational.young", "true", ["number"]),
        (swap("young = 5e5, ", ""), "object 'beam'", "effects.corotational.young", "", ["missing"]),
        (swap("young = 5e5", "young = []"), "object 'beam'", "effects.corotational.young", "[]", ["region", "where"]),
        (swap("young = 5e5", "young = [{ young = 1 }, { young = 2 }]"), "object 'beam'", "effects.corotational.young", "[{'young': 1}, {'young': 2}]", ["region 1", "where"]),
        (swap("young = 5e5", 'young = [{ where = "X", young = 1 }]'), "object 'beam'", "effects.corotational.young[1].where", "'X'", ["comparison", "X, Y, Z", "min(a, b, ...)"]),
        (swap("young = 5e5", 'young = [{ where = "X<1", yung = 1 }]'), "object 'beam'", "effects.corotational.young[1].yung", "1", ["unknown", "'young'", "poisson"]),
        (swap("young = 5e5", "young = [3]"), "object 'beam'", "effects.corotational.young[1]", "3", ["table"]),
        (swap("poisson = 0.4", 'poisson = 0.4, rotation = "svd"'), "object 'beam'", "effects.corotational.rotation", "'svd'", ["'polar'", "'qr'"]),
        (swap("poisson = 0.4", 'poisson = 0.4, rotation = "qr", tangent = "exact"'), "object 'beam'", "effects.corotational", "", ["tangent", "rotation", '"polar"']),
        (swap("fixed =", "mass_spring = { young = 1e5, poisson = 0.3 }\nfixed ="), "object 'beam'", "effects.mass_spring", "", ["poisson", "corotational"]),
        (swap("fixed =", "mass_spring = { young = [{ young = 1e5, poisson = 0.3 }] }\nfixed ="), "object 'beam'", "effects.mass_spring", "", ["poisson", "corotational"]),
        (swap("fixed =", "mass_spring = true\nfixed ="), "object 'beam'", "effects.mass_spring", "", ["young", "springs", "stiffness"]),
        (swap("fixed =", "mass_spring = { springs = [[0, 1]] }\nfixed ="), "object 'beam'", "effects.mass_spring", "", ["stiffness", "N/m"]),
        (swap("fixed =", "mass_spring = { young = 1e5, stiffness = 3 }\nfixed ="), "object 'beam'", "effects.mass_spring", "", ["stiffness", "rest_length", "young"]),
        (swap("fixed =", "mass_spring = { springs = [[0, 1, 2]], stiffness = 1 }\nfixed ="), "object 'beam'", "effects.mass_spring.springs[1]", "(0, 1, 2)", ["2", "3"]),
        (swap("fixed =", 'mass_spring = { springs = "absent.txt", stiffness = 1 }\nfixed ='), "object 'beam'", "effects.mass_spring.springs", "'absent.txt'", ["no such file", "folder of the scene"]),
        (swap('"X < 0.01"', '"x < 0.01"'), "object 'beam'", "effects.fixed.where", "'x < 0.01'", ["'x'", "X", "Y", "Z"]),
        (swap('{ where = "X < 0.01" }', "true"), "object 'beam'", "effects.fixed", "", ["where", "list"]),
        (swap('{ where = "X < 0.01" }', "3"), "object 'beam'", "effects.fixed", "3", ["table", "true", "false"]),
        (swap("corotational", "corotated"), "object 'beam'", "effects.corotated", "", ["'corotational'", "neo_hookean", "touch"]),
        (swap("fixed =", '"../fixed" ='), "object 'beam'", "effects.../fixed", "", ["'fixed'", "neo_hookean"]),
        (swap("fixed =", "__init__ ="), "object 'beam'", "effects.__init__", "", ["no such effect", "neo_hookean"]),
        (swap("gravity = true", "gravty = true"), "", "effects.gravty", "true", ["'gravity'", "neo_hookean"]),
        (swap("gravity = true", 'fixed = { where = "true" }'), "", "effects.fixed", "", ["[object.effects]"]),
        (GOOD + "gravity = true\n", "object 'beam'", "effects.gravity", "true", ["[effects]"]),
        (swap("gravity = true", "gravity = { g = [0, 1] }"), "", "effects.gravity.g[3]", "", ["missing"]),
        (swap("gravity = true", "gravity = { g = [0, nan, 0] }"), "", "effects.gravity.g[2]", "nan", ["finite"]),
        (swap("gravity = true", "gravity = { g = 9.81 }"), "", "effects.gravity.g", "9.81", ["array"]),
        (swap("density = 1000", "[object.effects.rayleigh]\nmass = -1\n").replace("[object.effects]\n", "[object.effects.touch]\nmax_interactions = 0\n[object.effects.x]\n"), "object 'beam'", "effects.rayleigh.mass", "-1", ["0"]),
        (swap("dt = 0.02", "dt = 0"), "", "dt", "0", ["0"]),
        (swap("dt = 0.02", "dt = -0.02"), "", "dt", "-0.02", ["0"]),
        (swap("dt = 0.02", "dt = inf"), "", "dt", "inf", ["finite"]),
        (swap("dt = 0.02", "dt = nan"), "", "dt", "nan", ["finite"]),
        (swap("dt = 0.02", 'dt = "0.02"'), "", "dt", "'0.02'", ["number"]),
        (swap("dt = 0.02", ""), "", "dt", "", ["missing"]),
        (swap("dt = 0.02", "dt = 0.02\nsovler = {}"), "", "sovler", "", ["unknown", "'solver'", "effects", "integrator"]),
        (swap("tolerance = 1e-6", "tolerance = 1"), "", "solver.tolerance", "1", ["1"]),
        (swap("tolerance = 1e-6", "tolerence = 1"), "", "solver.tolerence", "1", ["unknown", "'tolerance'"]),
        (swap("tolerance = 1e-6", "max_iterations = 0"), "", "solver.max_iterations", "0", ["1"]),
        (swap("tolerance = 1e-6", "max_iterations = 5.5"), "", "solver.max_iterations", "5.5", ["whole number"]),
        (swap("tolerance = 1e-6", "omega = 2"), "", "solver.omega", "2", ["2"]),
        (swap("tolerance = 1e-6", "omega = 0"), "", "solver.omega", "0", ["0"]),
        (swap("tolerance = 1e-6", "drop_tolerance = 1"), "", "solver.drop_tolerance", "1", ["1"]),
        (swap("tolerance = 1e-6", "fill = -1"), "", "solver.fill", "-1", ["0"]),
        (swap("tolerance = 1e-6", 'schedule = "fair"'), "", "solver.schedule", "'fair'", ["'excess'", "'round_robin'"]),
        (swap("tolerance = 1e-6", 'first_factor = "no"'), "", "solver.first_factor", "'no'", ["'wait'", "'go'"]),
        (swap("tolerance = 1e-6", "schedule_rounds = 0.5"), "", "solver.schedule_rounds", "0.5", ["1"]),
        (swap("tolerance = 1e-6", 'preconditioner = "ilu"'), "", "solver.preconditioner", "'ilu'", ["auto", "none", "jacobi", "ssor", "incomplete_cholesky", "cholesky"]),
        (swap("tolerance = 1e-6", 'warp = "true"'), "", "solver.warp", "'true'", ["true", "false"]),
        (swap("tolerance = 1e-6", "warp = 1"), "", "solver.warp", "1", ["true", "false"]),
        (swap("tolerance = 1e-6", 'update = "every-0"'), "", "solver.update", "'every-0'", ["never", "async", "adaptive", "every-N", "lockstep-D"]),
        (swap("tolerance = 1e-6", 'update = "lockstep"'), "", "solver.update", "'lockstep'", ["every-N", "lockstep-D"]),
        (swap("tolerance = 1e-6", 'factor_precision = "half"'), "", "solver.factor_precision", "'half'", ["'auto'", "'float16'", "'float32'", "'float64'"]),
        (swap("tolerance = 1e-6", "warm_start = 1"), "", "solver.warm_start", "1", ["true", "false"]),
        (swap("tolerance = 1e-6", "budget = -1"), "", "solver.budget", "-1", ["0"]),
        (swap("[solver]", "[record]\nevery = 0\n[solver]"), "", "record.every", "0", ["1"]),
        (swap("[solver]", '[record]\ncompression = "gz"\n[solver]'), "", "record.compression", "'gz'", ["'lz4'", "'zstd'", "'none'"]),
        (swap("[solver]\ntolerance = 1e-6", "solver = 3").replace("[effects]\ngravity = true\n", ""), "", "solver", "3", ["table"]),
        (swap("density = 1000", "density = 1\nmass = 2"), "object 'beam'", "", "", ["density = 1", "mass = 2"]),
        (swap("density = 1000", 'masses = "all"'), "object 'beam'", "masses", "'all'", ["'volume'", "'equal'"]),
        (swap("density = 1000", "pose = { rotate = [0, 0] }"), "object 'beam'", "pose.rotate[3]", "", ["missing"]),
        (swap("density = 1000", "pose = { rotate = [0, 0, 0, 0] }"), "object 'beam'", "pose.rotate", "(0, 0, 0, 0)", ["3", "4"]),
        (swap("density = 1000", "position = [0, 0, 0]"), "object 'beam'", "position", "[0, 0, 0]", ["unknown", "density", "mesh", "pose"]),
        (swap("bar = [2, 1, 1]", "bar = [2, 0, 1]"), "object 'beam'", "mesh.bar[2]", "0", ["1"]),
        (swap("size = [2, 1, 1]", "size = [2, -1, 1]"), "object 'beam'", "mesh.size[2]", "-1", ["0"]),
        (swap(", size = [2, 1, 1]", ""), "object 'beam'", "mesh", "", ["bar", "size", "file"]),
        (swap("bar = [2, 1, 1], size = [2, 1, 1]", 'file = "liver.msh"'), "object 'beam'", "mesh.file", "'liver.msh'", ["no such file"]),
        (swap("bar = [2, 1, 1], size = [2, 1, 1]", 'file = "a\\u0000b"'), "object 'beam'", "mesh.file", "'a\\x00b'", ["no such file"]),
        (swap('mesh = { bar = [2, 1, 1], size = [2, 1, 1] }', ""), "object 'beam'", "mesh", "", ["missing"]),
        (swap('name = "beam"', ""), "object 1", "name", "", ["missing"]),
        (swap('name = "beam"', 'name = "my beam"'), "object 'my beam'", "name", "'my beam'", ["1 to 64", "A-Z"]),
        (swap('name = "beam"', 'name = "a/b"'), "object 'a/b'", "name", "'a/b'", ["1 to 64", "A-Z"]),
        (swap('name = "beam"', 'name = "beam\\n"'), "object 'beam\\n'", "name", "'beam\\n'", ["1 to 64", "A-Z"]),
        (swap('name = "beam"', 'name = ""'), "object 1", "name", "''", ["1 to 64", "A-Z"]),
        (swap('name = "beam"', f'name = "{"b" * 65}"'), "object 'bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb'", "name", "'bbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbbb'", ["1 to 64"]),
        (swap('name = "beam"', "name = 7"), "object 1", "name", "7", ["string"]),
        (GOOD + SECOND, "", "object", "", ["differ", "beam"]),
        ("dt = 0.02\n", "", "object", "", ["[[object]]"]),
        ("dt = 0.02\nobject = []\n", "", "object", "", ["[[object]]"]),
        ("dt = 0.02\n[object]\nname = 'a'\n", "", "object", "", ["[[object]]"]),
        ("dt = 0.02\nobject = [3]\n", "object 1", "", "3", ["table"]),
        ("dt = 0.02\nobject = 3\n", "", "object", "", ["array"]),
        ("dt = 0.02\nname beam\n", "", "", "", ["TOML", "line 2"]),
        ("dt = 0.02\nname = beam\n", "", "", "", ["TOML", "line 2, column 8"]),
        ("dt = 0.02\ndt = 0.03\n", "", "", "", ["TOML", "line 2"]),
        (b"dt = 0.02 # \xff\n", "", "", "", ["UTF-8", "byte 12"]),
    ],
)  # fmt: skip
def test_malformed_scene(tmp_path, text, owner, key, value, allowed):
    """The object, the key, the value as written, and what is allowed instead."""
    lines = [re.sub(r"^scene \S*beam\.toml(?=[,:] )", "", line) for line in message(tmp_path, text).splitlines()]
    assert all(line.startswith((", ", ": ")) for line in lines), "each line names the file"
    place = "".join((f", {owner}" if owner else "", f", {key}" if key else "", f" = {value}" if value else "", ": "))
    reasons = [line.removeprefix(place) for line in lines if line.startswith(place)]
    assert len(reasons) == 1, lines
    assert [part for part in allowed if part not in reasons[0]] == [], reasons


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (swap("poisson = 0.4", "poisson = 0.5"), ", object 'beam', effects.corotational.poisson = 0.5: must be less than 0.5"),
        (swap("corotational =", "neo_hookean =").replace("0.4", "-0.1"), ", object 'beam', effects.neo_hookean.poisson = -0.1: must be 0 or more: below, lambda is negative, and the energy falls without bound where an element is pressed flat; corotational, st_venant_kirchhoff and stable_neo_hookean take such a material"),
        (swap("fixed =", "fibres = { stiffness = 1, direction = [1, 0, 0], floor = 0.1 }\nfixed ="), ", object 'beam', effects.fibres.floor = 0.1: unknown key (known keys: direction, exponent, stiffness)"),
        (swap("young = 5e5", 'young = [{ where = "X", young = 1 }]'), ', object \'beam\', effects.corotational.young[1].where = \'X\': \'X\' must be a comparison, not a number; allowed: the rest coordinates X, Y, Z [m], numbers, + - * / **, comparisons (< <= > >= == !=, also chained), and, or, not, parentheses, abs(a), sqrt(a), min(a, b, ...), max(a, b, ...), group("NAME") of the mesh, true'),
        (swap("poisson = 0.4", 'poisson = 0.4, rotation = "svd"'), ", object 'beam', effects.corotational.rotation = 'svd': must be 'polar' or 'qr'"),
        (swap("fixed =", "mass_spring = { springs = [[0, 1, 2]], stiffness = 1 }\nfixed ="), ", object 'beam', effects.mass_spring.springs[1] = (0, 1, 2): must have at most 2 items, not 3"),
        (GOOD + "gravity = true\n", ", object 'beam', effects.gravity = true: effect 'gravity' does not belong here; it acts on the whole scene: list it under [effects] at the top of the file"),
        (swap("tolerance = 1e-6", 'preconditioner = "ilu"'), ", solver.preconditioner = 'ilu': must be one of auto, none, jacobi, block_jacobi, ssor, ssor_factor, incomplete_cholesky, cholesky"),
        (swap("tolerance = 1e-6", 'update = "every-0"'), ', solver.update = \'every-0\': must be "never", "async", "adaptive", "every-N" or "lockstep-D" with a whole number of steps, as "every-30"'),
        (swap("density = 1000", "density = 1\nmass = 2"), ", object 'beam': give density or mass, not both (density = 1, mass = 2)"),
    ],
)  # fmt: skip
def test_specimens_of_whole_messages(tmp_path, text, told):
    """Ten, for their style."""
    assert re.sub(r"^scene \S*beam\.toml", "", message(tmp_path, text)) == told


def test_a_long_path_is_cut(tmp_path):
    found = message(tmp_path, swap("bar = [2, 1, 1], size = [2, 1, 1]", f'file = "{"b" * 5000}"'))
    assert ", object 'beam', mesh.file = 'bbb" in found and "bbb...: no such file (" in found


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
