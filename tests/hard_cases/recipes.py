# SPDX-License-Identifier: MIT
"""The classic list of what breaks simulators of deformable bodies, and the cases of each entry."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Recipe:
    """origin: who made it known, or where it is usual. cases: beginnings of names of cases, effects and models.
    tests: files that hold what is no run of a scene."""

    what: str
    origin: str
    cases: tuple[str, ...]
    tests: tuple[str, ...] = ()


RECIPES = (
    Recipe(
        "nodes anywhere in the bounding box",
        "Irving, Teran, Fedkiw 2004; Smith et al. 2018",
        ("random",),
        ("tests/hard_cases/seeds.py",),
    ),
    Recipe(
        "pressed into a plane, a line, a point", "Irving et al. 2004", ("flat", "a line", "a point", "pressed flat")
    ),
    Recipe("inside out", "Irving et al. 2004", ("inside out", "swapped layers")),
    Recipe(
        "pulled to ten lengths",
        "Smith et al. 2018",
        ("stretched", "pulled away", "torn by a grab", "pulled to ten lengths"),
    ),
    Recipe("twisted", "Smith et al. 2018", ("4 turns", "10 turns", "twisted")),
    Recipe(
        "pressed to a tenth, poked, shaken",
        "usual demonstrations",
        ("pressed to a tenth", "poked with 1000 N", "plasticity, crushed flat", "shaken"),
    ),
    Recipe("nearly incompressible", "NAFEMS; locking of linear elements", ("Poisson 0.4", "nearly incompressible")),
    Recipe("ratios of stiffness", "heterogeneous beams", ("stiffness", "a stiffness that jumps")),
    Recipe("ratios of mass", "stacks", ("mass ratio", "heavy on soft")),
    Recipe("slivers", "meshes by Delaunay's criterion", ("slivers",)),
    Recipe("large time steps, schemes", "Baraff, Witkin 1998", ("time step", "newmark", "bdf2", "ros2")),
    Recipe("fast spin", "corotational elements", ("spin ",)),
    Recipe("a pose", "the warp of a factor", ("a pose",), ("tests/solver/test_warp.py",)),
    Recipe(
        "indefinite stiffness",
        "columns that buckle; St. Venant-Kirchhoff in compression",
        ("a column", "cable drawn in", "growth"),
    ),
    Recipe(
        "singular systems", "meshes of users", (), ("tests/scene/test_bad_scenes.py", "tests/scene/test_mesh_files.py")
    ),
    Recipe("sudden contact", "drop tests", ("1 m/s", "10 m/s", "50 m/s", "fast and small", "struck by a tool")),
    Recipe("contact that flickers", "wedges, saws", ("wedge", "a saw")),
    Recipe("cuts", "surgery", ("cut", "all but one", "all elements", "damage"), ("tests/cutting",)),
    Recipe(
        "sudden loads, commands of users",
        "service",
        (
            "violent push",
            "fifty hands",
            "muscle, 1e6",
            "pressure, 1e3",
            "wind of 1000",
            "prony, a jump",
            "a holder that jumps",
        ),
        ("tests/hard_cases/test_extremes.py",),
    ),
    Recipe("long runs", "service", ("at rest", "periodic load", "spin, ")),
    Recipe(
        "bad factors",
        "a factor of another time, object or matrix",
        ("poisoned", "old factor"),
        ("tests/hard_cases/test_extremes.py", "tests/system/test_hostile_answers.py"),
    ),
    Recipe("no worker", "service", ("no worker",), ("tests/faults/test_faults.py",)),
)


def recipe_of(name: str) -> int:
    """Number of the recipe, from 1; 0: none."""
    return next((k for k, recipe in enumerate(RECIPES, 1) if name.startswith(recipe.cases or ("\0",))), 0)
