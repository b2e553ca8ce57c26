# SPDX-License-Identifier: MIT
"""THE TABLE of hard cases of effects: contact, cuts, memory, loads and ties (run by of_effects.py)."""

from collections.abc import Callable
from typing import Any

import numpy as np

from sim_server.mechanics.numbers import text_of
from sim_server.simulation import Simulation
from tests.hard_cases.of_effects import (
    TOLD,
    EffectCase,
    Random,
    Table,
    back_to_rest,
    below_floor,
    energy_rise,
    free_fall,
    of_order,
    passed,
    speed,
    still,
    tells,
)
from tests.hard_cases.recipe_table import RECIPES
from tests.scenes import bar
from tests.state import put

GRAVITY: Table = {"gravity": {"g": [0, -9.81, 0]}}
FLOOR: Table = {"name": "floor", "shape": "plane"}
REST = "from rest at the end, over the length, within"
GIVEN = "kinetic energy over the work of gravity and loads within"
SPEED = "speed at the end, in m/s, within"
TELLS = "finite, and told where it is frozen"


def cube(name: str = "cube", at: tuple[float, float, float] = (0, 0.002, 0), **table: Any) -> Table:
    """An [[object]] of 0.1 m."""
    effects = table.pop("own", {})
    size = table.pop("size", (0.1, 0.1, 0.1))
    found = bar(table.pop("cells", (3, 3, 3)), size, **{"name": name, "pose": {"translate": list(at)}} | table)
    return found | {"effects": found["effects"] | effects}


def touching(*objects: Table, obstacle: list[Table] | None = None, **table: Any) -> Table:
    """A scene with contact."""
    return {"object": list(objects), "obstacle": obstacle or [FLOOR], "effects": GRAVITY | {"contact": {}}} | table


def alone(*objects: Table, gravity: bool = False, **table: Any) -> Table:
    return {"object": list(objects), "effects": GRAVITY if gravity else {}} | table


def setting(at: int, **values: str) -> Callable[[Simulation, int], None]:
    """Sets parameters before a step; __ stands for the point in their keys."""
    given = {key.replace("__", "."): value for key, value in values.items()}

    def act(sim: Simulation, step: int) -> None:
        if step == at:
            sim.parameters.set(given)

    return act


def both(*acts: Callable[[Simulation, int], None]) -> Callable[[Simulation, int], None]:
    def act(sim: Simulation, step: int) -> None:
        for each in acts:
            each(sim, step)

    return act


def cutting(at: int, part: float, left: int = 0) -> Callable[[Simulation, int], None]:
    """Removes elements of the first object at random: a part of them, or all but so many."""

    def act(sim: Simulation, step: int) -> None:
        if step == at:
            count = len(sim.world.bodies[0].mesh.tets)
            gone = np.random.default_rng(count).permutation(count)[: count - left if left else int(part * count)]
            sim.parameters.set({f"{sim.world.bodies[0].name}.cutting.removed": f'"{text_of(gone)}"'})

    return act


def half_cut(at: int) -> Callable[[Simulation, int], None]:
    """Removes a layer of elements in the middle along x."""

    def act(sim: Simulation, step: int) -> None:
        if step == at:
            x = sim.world.bodies[0].centroids[:, 0]
            gone = np.flatnonzero(np.abs(x - x.mean()) < 0.2 * np.ptp(x))
            sim.parameters.set({f"{sim.world.bodies[0].name}.cutting.removed": f'"{text_of(gone)}"'})

    return act


def thrown(*velocity: float) -> Callable[[Simulation, Random], None]:
    """The last object, at a velocity with a tenth of random parts [m/s]."""

    def begin(sim: Simulation, random: Random) -> None:
        v = sim.world.v.copy()
        size = float(np.linalg.norm(velocity))
        v[sim.world.bodies[-1].nodes] = np.array(velocity) + random.uniform(-0.1, 0.1, 3) * size
        v[sim.world.free == 0] = 0
        put(sim, sim.world.v, v)

    return begin


SLOPES = [
    {"name": side, "shape": "plane", "friction": 0.2, "pose": {"rotate": [0, 0, turn], "translate": [0.05, 0, 0.05]}}
    for side, turn in (("left", -60), ("right", 60))
]
RAM: Table = {
    "name": "ram",
    "shape": "box",
    "size": [1, 0.1, 1],
    "keyframes": [{"time": t, "translate": [0, y, 0]} for t, y in ((0, 0.2), (0.5, 0.08), (0.6, 0.08), (0.8, 0.5))],
}
TOOL: Table = {
    "name": "tool",
    "shape": "sphere",
    "radius": 0.05,
    "moved": "client",
    "max_speed": 20,
    "pose": {"translate": [0.05, 0.3, 0.05]},
}
LOOSE = {"rayleigh": {"mass": 5.0}}
CABLE = {"path": [[0, 0.1, 0.1], [0.0333, 0.1, 0.1], [0.1, 0.1, 0.1]], "shortening": 0.0}
END = "X > 0.0999"
HELD = {"fixed": {"where": "X < 1e-4"}}


def _struck(sim: Simulation, step: int) -> None:
    """Moves the tool through the body, there and back, each time in a step or two."""
    if step % 20 == 0:
        y = 0.3 if step % 40 else -0.3
        assert sim.contact is not None
        sim.contact.move("tool", (0.05, y, 0.05), (1.0, 0.0, 0.0, 0.0))


def _drawn(sim: Simulation, step: int) -> None:
    """Draws the cable in by the whole length of the object, and lets it out again."""
    sim.parameters.set({"cube.cable.shortening": f"{0.1 * min(step, 20) / 20 if step < 60 else 0.0:g}"})


def _uneven(table: Table, random: Random) -> Table:
    """The object turned and moved by a little."""
    pose = table["pose"]
    turn, move = random.uniform(-3, 3, 3), random.uniform(0, 0.004, 3)
    return table | {
        "pose": {"rotate": turn.tolist(), "translate": (np.array(pose["translate"]) + move + [0, 0.004, 0]).tolist()}
    }


def _heavy_on_soft(random: Random, density: float) -> Table:
    return touching(
        cube("soft", (-0.05, 0.002, -0.05), size=(0.2, 0.1, 0.2), density=100, young=1e6, own=LOOSE),
        _uneven(cube("heavy", (0, 0.112, 0), density=density, young=1e8, own=LOOSE), random),
    )


def _between(random: Random, *obstacles: Table) -> Table:
    return touching(_uneven(cube(at=(0, 0.15, 0), own=LOOSE), random), obstacle=list(obstacles))


def _plastic(random: Random, *obstacles: Table) -> Table:
    plasticity = {"yield_stress": 1e3 * random.uniform(1, 5), "hardening": 1e4}
    return touching(cube(own=LOOSE | {"plasticity": plasticity}), obstacle=list(obstacles))


def _hand(*keyframes: tuple[float, float]) -> Table:
    """Holds the end and moves it along x. keyframes: time [s], way [m]."""
    moves = [{"time": time, "translate": [way, 0, 0]} for time, way in keyframes]
    return {"name": "hand", "object": "cube", "where": END, "keyframes": moves}


def _torn(random: Random, way: float) -> Table:
    damage = {"strength": 1e3 * random.uniform(1, 3), "fracture_energy": 20.0}
    return alone(
        cube(cells=(6, 2, 2), own=HELD | LOOSE | {"damage": damage}), holder=[_hand((0, 0), (1, way))],
        integrator={"scheme": "backward_euler", "linearizations": 6},
    )  # fmt: skip


def _jumped(random: Random, way: float) -> Table:
    hand = _hand((0.2, 0), (0.21, way), (0.4, way), (0.41, 0))
    return alone(cube(own=HELD | LOOSE, density=random.uniform(500, 2000)), holder=[hand])


CONTACT = [
    EffectCase(
        "heavy on soft",
        "a cube of 1000 times the density falls 1 cm onto one of 1 MPa, and lies on it",
        "its middle below that of the soft one, in m, within",
        lambda r: _heavy_on_soft(r, 1e5),
        of_order,
        -0.05,
        200,
        easy=lambda r: _heavy_on_soft(r, 100),
    ),
    EffectCase(
        "wedge",
        "a cube falls between two planes of 60 degrees",
        SPEED,
        lambda r: _between(r, *SLOPES),
        speed,
        1e-3,
        300,
        easy=lambda r: _between(r, FLOOR),
    ),
    EffectCase(
        "fast and small on thin",
        "a cube of 2 cm at 50 m/s on a plate of 2 mm that is held at two sides",
        "its middle under the lowest node of the plate within, in m",
        lambda r: touching(
            bar(
                (10, 1, 10),
                (0.2, 0.002, 0.2),
                name="plate",
                young=1e7,
                fixed="X < 1e-4 or X > 0.1999",
                pose={"translate": [-0.1, 0.1, -0.1]},
            ),
            _uneven(cube("bullet", (-0.01, 0.115, -0.01), cells=(2, 2, 2), size=(0.02, 0.02, 0.02), young=1e6), r),
            dt=0.001,
        ),
        passed,
        0.0,
        100,
        unconverged={"contact": 10},
        begin=thrown(0, -50, 0),
    ),
    *(
        EffectCase(
            f"{speed} m/s on the floor",
            f"a cube, {speed / 10:g} of its lengths in a step",
            "below the floor within, in m",
            lambda r: touching(_uneven(cube(at=(0, 0.05, 0)), r)),
            below_floor,
            most,
            60,
            begin=thrown(0, -speed, 0),
            unconverged={"contact": 5},
        )
        for speed, most in ((1, 1e-3), (10, 1e-3), (50, 0.03))
    ),
    EffectCase(
        "struck by a tool",
        "a tool of a client goes through it at 20 m/s, there and back, five times",
        GIVEN,
        lambda r: touching(_uneven(cube(own=LOOSE), r), obstacle=[FLOOR, TOOL]),
        energy_rise,
        2.0,
        200,
        act=_struck,
        unconverged={"contact": 20},
    ),
]

CUTS = [
    EffectCase(
        "cut under load",
        "half of the elements of a held bar go while gravity bends it",
        GIVEN,
        lambda r: alone(cube(own=HELD | LOOSE | {"cutting": True}, density=r.uniform(500, 2000)), gravity=True),
        energy_rise,
        2.0,
        100,
        act=cutting(20, 0.5),
    ),
    EffectCase(
        "all but one element",
        "of a cube in free fall: the rest falls on",
        "other than free fall, as a part of it, within",
        lambda r: alone(cube(own={"cutting": True}, density=r.uniform(500, 2000)), gravity=True),
        free_fall,
        1e-9,
        60,
        act=cutting(20, 0, left=1),
    ),
    EffectCase(
        "all elements",
        "of a held bar, in motion: it stands still",
        SPEED,
        lambda r: alone(cube(own=HELD | {"cutting": True}, density=r.uniform(500, 2000)), gravity=True),
        speed,
        1e-9,
        60,
        act=cutting(20, 1.0),
    ),
    EffectCase(
        "cut through contact",
        "a cube that lies on the floor is cut through",
        SPEED,
        lambda r: touching(cube(own=LOOSE | {"cutting": True}, density=r.uniform(500, 2000), young=1e6)),
        still,
        1e-3,
        150,
        act=half_cut(40),
    ),
]

MEMORY = [
    EffectCase(
        "plasticity, crushed flat",
        "pressed to less than a third by a ram and let go",
        "below the floor within, in m",
        lambda r: _plastic(r, FLOOR, RAM),
        below_floor,
        1e-3,
        120,
        unconverged={"contact": 60},
        easy=lambda r: _plastic(r, FLOOR),
    ),
    EffectCase(
        "prony, a jump of the load",
        "a tension of a tenth of E comes and goes at once",
        REST,
        lambda r: alone(
            cube(
                own=HELD
                | LOOSE
                | {
                    "prony": {"terms": [{"g": 5.0, "tau": 0.02 * r.uniform(1, 3)}]},
                    "traction": {"where": END, "stress": [0, 0, 0]},
                }
            )
        ),
        back_to_rest,
        1e-3,
        300,
        act=both(setting(20, cube__traction__stress="[1e4, 0, 0]"), setting(60, cube__traction__stress="[0, 0, 0]")),
    ),
    EffectCase(
        "damage, torn through",
        "pulled at its end until it is torn, and on",
        GIVEN,
        lambda r: _torn(r, 0.2),
        energy_rise,
        2.0,
        120,
        unconverged={"max_linearizations": 120},
        easy=lambda r: _torn(r, 0.002),
    ),
]

LOADS = [
    EffectCase(
        "muscle, 1e6 times its stress",
        "for ten steps, then none",
        TELLS,
        lambda r: alone(cube(own=HELD | LOOSE | {"muscle": {"stress": r.uniform(1, 2), "direction": [1, 0, 0]}})),
        tells,
        0.0,
        120,
        unconverged=TOLD,
        act=both(setting(20, cube__muscle__stress="1e6"), setting(30, cube__muscle__stress="0")),
    ),
    EffectCase(
        "pressure, 1e3 times",
        "a follower pressure of ten times E on all of a free cube, for ten steps",
        TELLS,
        lambda r: alone(cube(own=LOOSE | {"traction": {"where": "true", "pressure": r.uniform(1, 2)}})),
        tells,
        0.0,
        120,
        unconverged=TOLD,
        act=both(setting(20, cube__traction__pressure="1e6"), setting(30, cube__traction__pressure="0")),
    ),
    *(
        EffectCase(
            name,
            "by the whole length of the object, and let out again",
            REST,
            lambda r, more=more: alone(
                cube(own=HELD | LOOSE | {"cable": CABLE | {"stiffness": 1e4 * r.uniform(1, 3)}}), **more
            ),
            back_to_rest,
            1e-3,
            300,
            act=_drawn,
            unconverged={"max_linearizations": 100},
        )
        for name, more in (
            ("cable drawn in", {}),
            ("cable drawn in, Newton", {"integrator": {"linearizations": 10}}),
        )
    ),
    EffectCase(
        "growth to a twentieth",
        "of its length and back, in single steps",
        REST,
        lambda r: alone(
            cube(own=HELD | LOOSE | {"growth": {"expansion": -0.949, "amount": 0.0}}, density=r.uniform(500, 2000))
        ),
        back_to_rest,
        1e-3,
        500,
        act=both(setting(20, cube__growth__amount="1"), setting(60, cube__growth__amount="0")),
    ),
    EffectCase(
        "wind of 1000 m/s",
        "on a held cube, for ten steps",
        TELLS,
        lambda r: alone(cube(own=HELD | LOOSE | {"wind": {"velocity": [0, 0, 0]}}, density=r.uniform(500, 2000))),
        tells,
        0.0,
        200,
        unconverged=TOLD,
        act=both(setting(20, cube__wind__velocity="[0, 1e3, 0]"), setting(30, cube__wind__velocity="[0, 0, 0]")),
    ),
    EffectCase(
        "a holder that jumps",
        "two lengths in a step, and back",
        REST,
        lambda r: _jumped(r, 0.2),
        back_to_rest,
        1e-3,
        400,
        easy=lambda r: _jumped(r, 0.002),
    ),
    EffectCase(
        "a stiffness that jumps by 1e6",
        "up and down again, under gravity",
        GIVEN,
        lambda r: alone(cube(own=HELD | LOOSE, density=r.uniform(500, 2000)), gravity=True),
        energy_rise,
        2.0,
        150,
        act=both(setting(30, cube__corotational__young="1e11"), setting(60, cube__corotational__young="1e5")),
    ),
]

EFFECT_CASES = [*CONTACT, *CUTS, *MEMORY, *LOADS, *RECIPES]
