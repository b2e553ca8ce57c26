# SPDX-License-Identifier: MIT
# ruff: noqa: E501 (one row per malformed scene reads better than wrapped rows)
"""[[obstacle]] tables, and contact as a whole: what is read, what is filled in, what is refused and in which words."""

import json

import meshio
import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.scene import load
from sim_server.scene.model import Scene

GOOD = """\
dt = 0.02
[effects]
contact = true
[[object]]
name = "beam"
mesh = { bar = [2, 1, 1], size = [2, 1, 1] }
[[object]]
name = "other"
mesh = { bar = [1, 1, 1], size = [1, 1, 1] }
friction = 0.1
[[obstacle]]
name = "floor"
shape = "plane"
friction = 0.2
[[obstacle]]
name = "tool"
shape = "sphere"
radius = 0.1
"""


def read(tmp_path, text, *overrides):
    path = tmp_path / "scene.toml"
    path.write_text(text)
    return load(path, overrides)


def message(tmp_path, text, *overrides):
    with pytest.raises(InputError) as error:
        read(tmp_path, text, *overrides)
    return str(error.value)


def swap(old, new):
    assert old in GOOD
    return GOOD.replace(old, new)


def test_what_is_left_out_is_filled_in_and_resolves_to_the_same_scene(tmp_path):
    scene = read(tmp_path, GOOD)
    assert [o.friction for o in scene.objects] == [0.5, 0.1]
    table = json.loads(json.dumps(scene.resolved()))
    assert Scene.model_validate(table).resolved() == scene.resolved()
    pose = {"rotate": [0, 0, 0], "translate": [0, 0, 0]}
    assert table["obstacle"] == [
        {"name": "floor", "shape": "plane", "friction": 0.2, "pose": pose},
        {"name": "tool", "shape": "sphere", "radius": 0.1, "friction": 0.5, "pose": pose},
    ]


def test_every_kind_of_obstacle_resolves_to_itself(tmp_path):
    meshio.Mesh(np.eye(4, 3), [("triangle", [[0, 1, 2], [0, 3, 1], [1, 3, 2], [0, 2, 3]])]).write(tmp_path / "a.stl")
    text = (
        GOOD
        + """
[[obstacle]]
name = "box"
shape = "box"
size = [1, 2, 3]
keyframes = [{ time = 0, translate = [0, 1, 0] }, { time = 1.5, rotate = [0, 10, 0] }]
[[obstacle]]
name = "capsule"
shape = "capsule"
radius = 0.1
length = 2
moved = "client"
max_speed = 3
[[obstacle]]
name = "organ"
shape = "grid"
file = "a.stl"
spacing = 0.05
scale = 0.001
"""
    )
    text = text.replace(
        "contact = true", 'contact = { friction = [{ between = ["beam", "box"], value = 0 }], passes = 3 }'
    )
    scene = read(tmp_path, text)
    assert scene.obstacles[3].max_speed == 3 and scene.obstacles[3].max_turn == 3.0
    assert scene.obstacles[4].file == str(tmp_path / "a.stl")
    again = Scene.model_validate(json.loads(json.dumps(scene.resolved())))
    assert again.resolved() == scene.resolved() and again.obstacles == scene.obstacles


def test_a_scene_without_contact_has_nothing_of_it(tmp_path):
    start, end = GOOD.index("[effects]"), GOOD.index("[[obstacle]]")
    text = (GOOD[:start] + GOOD[GOOD.index("[[object]]") : end]).replace("friction = 0.1\n", "")
    resolved = read(tmp_path, text).resolved()
    assert "obstacle" not in resolved and resolved["effects"] == {}
    assert all("friction" not in o for o in resolved["object"])


def test_one_value_of_an_obstacle_is_overridden_by_name(tmp_path):
    scene = read(tmp_path, GOOD, "obstacle.tool.radius=0.25", "obstacle.floor.pose.translate=[0, 1, 0]")
    assert scene.obstacles[1].radius == 0.25 and scene.obstacles[0].pose.translate == (0, 1, 0)
    assert "no obstacle 'tol' with a key after it; did you mean 'tool'?" in message(
        tmp_path, GOOD, "obstacle.tol.radius=1"
    )


def test_a_gpu_takes_objects_that_touch_each_other(tmp_path):
    read(tmp_path, GOOD).check_device("gpu")


@pytest.mark.parametrize("scheme", ["newmark", "bdf2", "generalized_alpha", "ros2"])
def test_on_a_gpu_bodies_in_contact_take_backward_euler_alone(tmp_path, scheme):
    one = swap("contact = true", f'contact = {{ between = false }}\n[integrator]\nscheme = "{scheme}"')
    scene = read(tmp_path, one)
    scene.check_device("cpu")
    with pytest.raises(InputError, match=f"integrator.scheme = '{scheme}' on a GPU; .* --device cpu"):
        scene.check_device("gpu")


def test_on_a_gpu_contact_has_one_linearization(tmp_path):
    one = swap("contact = true", "contact = { between = false }\n[integrator]\nlinearizations = 3")
    scene = read(tmp_path, one)
    scene.check_device("cpu")
    with pytest.raises(InputError, match=r"integrator.linearizations = 3 on a GPU; allowed: 1, or --device cpu"):
        scene.check_device("gpu")


TOOL = 'shape = "sphere"\nradius = 0.1\n'
REFUSED = [
    (swap("radius = 0.1", "radius = -1"), ["obstacle 'tool', radius = -1", "greater than 0"]),
    (swap("radius = 0.1", "radios = 1"), ["obstacle 'tool', radios = 1", "did you mean 'radius'"]),
    (swap("radius = 0.1", ""), ["obstacle 'tool'", "shape 'sphere' needs radius"]),
    (
        swap("radius = 0.1", "radius = 1\nsize = [1, 1, 1]"),
        ["obstacle 'tool'", "shape 'sphere' has no size; allowed: radius"],
    ),
    (swap('"plane"', '"plane"\nspacing = 1'), ["obstacle 'floor'", "shape 'plane' has no spacing; allowed: none"]),
    (swap('"plane"', '"cone"'), ["obstacle 'floor', shape = 'cone'", "'plane', 'sphere', 'box', 'capsule' or 'grid'"]),
    (swap("friction = 0.2", "friction = -0.2"), ["obstacle 'floor', friction = -0.2", "greater than or equal to 0"]),
    (swap("friction = 0.1", "friction = -0.1"), ["object 'other', friction = -0.1", "greater than or equal to 0"]),
    (swap(TOOL, 'shape = "capsule"\nradius = 1\n'), ["obstacle 'tool'", "shape 'capsule' needs length"]),
    (swap(TOOL, 'shape = "box"\nsize = [1, 0, 1]\n'), ["obstacle 'tool', size[2] = 0", "greater than 0"]),
    (
        swap(TOOL, 'shape = "grid"\nspacing = 0.1\nfile = "absent.stl"\n'),
        ["obstacle 'tool', file = 'absent.stl'", "no such file"],
    ),
    (swap(TOOL, TOOL + "max_speed = 1\n"), ["obstacle 'tool'", 'max_speed without moved = "client"']),
    (swap(TOOL, TOOL + 'moved = "hand"\n'), ["obstacle 'tool', moved = 'hand'", "'client'"]),
    (swap(TOOL, TOOL + 'moved = "client"\nkeyframes = [{ time = 0 }]\n'), ["obstacle 'tool'", "one of the two"]),
    (swap(TOOL, TOOL + "keyframes = []\n"), ["obstacle 'tool', keyframes = []", "at least 1"]),
    (
        swap(TOOL, TOOL + "keyframes = [{ time = -1 }]\n"),
        ["obstacle 'tool', keyframes[1].time = -1", "greater than or equal to 0"],
    ),
    (
        swap(TOOL, TOOL + "keyframes = [{ time = 1 }, { time = 1 }]\n"),
        ["obstacle 'tool'", "time 1 s after 1 s; times must ascend"],
    ),
    (
        swap(TOOL, TOOL + "keyframes = [{ time = 0 }]\npose = { translate = [1, 0, 0] }\n"),
        ["obstacle 'tool'", "leave pose out"],
    ),
    (swap('"tool"', '"floor"'), ["obstacle 'floor'", "names must differ", "floor"]),
    (swap('"tool"', '"beam"'), ["obstacle 'beam'", "names must differ, also those of objects and obstacles", "beam"]),
    (swap('"tool"', '"a tool"'), ["obstacle 'a tool', name = 'a tool'", "1 to 64 characters"]),
    (swap("contact = true", ""), ["obstacle 'floor'", "list contact = true under [effects]"]),
    (swap("contact = true", "contact = false"), ["obstacle 'floor'", "list contact = true under [effects]"]),
    (
        GOOD[: GOOD.index("[[obstacle]]")].replace("contact = true", "contact = { between = false }"),
        ["effects.contact", "needed: an [[obstacle]], another object, or self = true"],
    ),
    (
        swap('[[object]]\nname = "beam"', '[integrator]\nscheme = "quasi_static"\n[[object]]\nname = "beam"'),
        ["effects.contact", "'quasi_static'", "'backward_euler', 'newmark', 'bdf2', 'generalized_alpha', 'ros2'"],
    ),
    (
        swap(
            '[[object]]\nname = "beam"',
            '[integrator]\nscheme = "bdf2"\n[solver]\nbudget = 0.1\n[[object]]\nname = "beam"',
        ),
        ["solver.budget = 0.1 with contact", '"bdf2"', '"backward_euler"'],
    ),
    (swap("contact = true", "contact = { thickness = 0 }"), ["effects.contact.thickness = 0", "greater than 0"]),
    (swap("contact = true", "contact = { passes = 0 }"), ["effects.contact.passes = 0", "1"]),
    (swap("contact = true", "contact = { tolerance = 1 }"), ["effects.contact.tolerance = 1", "less than 1"]),
    (swap("contact = true", "contact = { kappa = 1 }"), ["effects.contact.kappa = 1", "unknown key", "stiffness"]),
    (
        swap("contact = true", 'contact = { friction = [{ between = ["beam", "flor"], value = 1 }] }'),
        ["effects.contact.friction[1].between", "no object or obstacle 'flor'", "'floor'"],
    ),
    (
        swap("contact = true", 'contact = { friction = [{ between = ["tool", "floor"], value = 1 }] }'),
        ["floor and tool: must be an object, and an obstacle or another object"],
    ),
    (
        swap("contact = true", 'contact = { friction = [{ between = ["beam", "beam"], value = 1 }] }'),
        ["must be an object, and an obstacle or another object"],
    ),
    (
        swap("contact = true", 'contact = { friction = [{ between = ["beam", "floor"], value = -1 }] }'),
        ["effects.contact.friction[1].value = -1", "greater than or equal to 0"],
    ),
    (
        swap(
            "contact = true",
            'contact = { friction = [{ between = ["beam", "floor"], value = 1 }, { between = ["floor", "beam"], value = 1 }] }',
        ),
        ["effects.contact.friction[2].between", "beam and floor stand in the list already"],
    ),
    (
        GOOD[: GOOD.index("[[obstacle]]")] + '[obstacle]\nname = "floor"\nshape = "plane"\n',
        ["write [[obstacle]] with double brackets, once per obstacle"],
    ),
]


@pytest.mark.parametrize(("text", "said"), REFUSED)
def test_what_cannot_be_is_refused_with_its_place(tmp_path, text, said):
    found = message(tmp_path, text)
    assert found.startswith("scene scene.toml")
    assert "\n" not in found
    for words in said:
        assert words in found
