# SPDX-License-Identifier: MIT
"""The table [accuracy], the budget of a step, and what follows for the other tables."""

import math

import pytest

from sim_server.errors import InputError
from sim_server.scene import Scene, load
from sim_server.simulation import Simulation

SCENE = """
dt = 0.01
[effects]
gravity = true
[solver]
preconditioner = "block_jacobi"
[[object]]
name = "bar"
mesh = { bar = [4, 1, 1], size = [0.2, 0.05, 0.1] }
pose = { rotate = [0, 0, 45] }
[object.effects]
corotational = { young = 1e5, poisson = 0.3 }
fixed = { where = "X < 0.001" }
"""
POSITION = "accuracy.position=1e-3"


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)

    def loaded(*overrides: str) -> Scene:
        return load(path, overrides)

    return loaded


@pytest.mark.parametrize("given", ["0.5 %", "0.5%", "5e-1 %"])
def test_a_percentage_is_of_the_largest_extent_before_the_pose(scene, given):
    rest = scene().objects[0].load_mesh().rest
    accuracy = scene(f"accuracy.position='{given}'").accuracy
    assert accuracy.position_of(rest) == pytest.approx(1e-3, rel=1e-12)
    assert scene(POSITION).accuracy.position_of(rest) == 1e-3


@pytest.mark.parametrize(
    "given", ["0", "-1e-3", "true", "'0 %'", "'101 %'", "'1'", "'-1 %'", "inf", "nan", "[1e-3]", "'e %'"]
)
def test_other_positions_are_refused(scene, given):
    with pytest.raises(InputError, match=r"accuracy\.position.*must be a length above 0 \[m\], or a part"):
        scene(f"accuracy.position={given}")


def test_tolerances_that_are_not_given_become_rounding(scene):
    found = scene(POSITION)
    assert (found.solver.tolerance, found.integrator.tolerance, found.integrator.linearizations) == (1e-12, 1e-12, 8)
    given = ("solver.tolerance=1e-3", "integrator.tolerance=1e-2", "integrator.linearizations=3")
    found = scene(POSITION, *given)
    assert (found.solver.tolerance, found.integrator.tolerance, found.integrator.linearizations) == (1e-3, 1e-2, 3)


def test_the_resolved_scene_is_the_same_scene_again(scene):
    found = scene(POSITION)
    again = Scene.model_validate(found.resolved())
    assert again.resolved() == found.resolved()
    assert "accuracy" not in scene().resolved() and "budget_ms" not in scene().resolved()["solver"]


@pytest.mark.parametrize("other", ["effects.contact.self=true", "solver.budget=0.1", "integrator.scheme=ros2"])
def test_linearizations_are_not_raised_where_one_is_all_there_may_be(scene, other):
    found = scene(POSITION, other)
    assert (found.integrator.linearizations, found.integrator.tolerance) == (1, 1e-4)
    assert found.solver.tolerance == 1e-12


REFUSED = {
    (POSITION, "integrator.scheme=central_difference", "solver.preconditioner=auto"): "which solves no equations",
    (POSITION, "integrator.scheme=ros2", "integrator.solve=factor", "solver.preconditioner=auto"): "without iterations",
    (POSITION, "solver.preconditioner=none"): "which tells nothing of errors",
    ("accuracy.positions=1e-3",): "unknown key; did you mean 'position'",
    ("solver.budget_ms=1", "solver.budget=1"): "solver.budget_ms = 1 with budget = 1",
    ("solver.budget_ms=1", "integrator.scheme=ros2"): '"ros2", which cannot end a step early',
    ("solver.budget_ms=1", "effects.contact.self=true", "integrator.scheme=bdf2"): "allowed: \"backward_euler\"",
    ("solver.budget_ms=1", "effects.contact.self=true", "integrator.linearizations=2"): "no search in contact",
    ("solver.budget_ms=0",): "solver.budget_ms",
}  # fmt: skip


@pytest.mark.parametrize(("given", "message"), REFUSED.items(), ids=lambda value: value[0] if value[1:] else "")
def test_contradictions_are_refused(scene, given, message):
    with pytest.raises(InputError, match=message):
        scene(*given)


@pytest.mark.parametrize(("name", "value"), [("budget", 1e-3), ("budget_ms", 2.0)])
def test_a_budget_ends_no_solve_of_several_passes_on_a_gpu(scene, name, value):
    scene(f"solver.{name}={value}").check_device("gpu")
    touching = scene(f"solver.{name}={value}", "effects.contact.self=true")
    touching.check_device("cpu")
    with pytest.raises(InputError, match=rf"solver\.{name} = {value:g} with contact on a GPU"):
        touching.check_device("gpu")


def test_the_loop_has_it_in_metres(scene):
    settings = Simulation(scene("accuracy.position='0.5 %'", "solver.budget_ms=2")).engine.settings(0)
    assert math.isclose(settings.position, 1e-3) and settings.dx_dv == 0.01
    assert settings.step_budget == 2e-3
    settings = Simulation(scene("integrator.scheme=newmark")).engine.settings(0)
    assert (settings.position, settings.step_budget, settings.dx_dv) == (0, 0, 0.005)
