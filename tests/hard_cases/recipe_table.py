# SPDX-License-Identifier: MIT
"""Hard cases that need more than a start: pulled, twisted and pressed bodies, poses, columns that buckle, teeth, many
hands (rows of the table of effects, run by of_effects.py)."""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sim_server.simulation import Simulation
from tests.hard_cases.of_effects import EffectCase, Random, Table, Trace, back_to_rest, below_floor, energy_rise, still
from tests.scenes import bar
from tests.state import put

REST, SPEED = "from rest at the end, over the length, within", "speed at the end, in m/s, within"
GIVEN = "kinetic energy over the work of gravity and loads within"
GRAVITY: Table = {"gravity": {"g": [0, -9.81, 0]}}
DAMPED: Table = {"rayleigh": {"mass": 5.0}}
KNOTTED = (
    "Wound up by ten turns the bar of four widths goes through itself (it has no contact with itself), and turned back "
    "it comes to rest wound up. Every step is solved."
)
STABLE: Table = {"stable_neo_hookean": {"young": 1e5, "poisson": 0.45}}


def long_bar(own: Table, density: float = 1000.0, **table: Any) -> Table:
    """An [[object]] of 0.4 x 0.1 x 0.1 m along x, held at X = 0."""
    found = bar((8, 2, 2), (0.4, 0.1, 0.1), **{"name": "bar", "young": None, "density": density} | table)
    return found | {"effects": DAMPED | {"fixed": {"where": "X < 1e-4"}} | own}


def held_at_the_end(own: Table, keyframes: list[Table], r: Random, **more: Any) -> Table:
    """The bar with its free end in a holder."""
    holder = {"name": "hand", "object": "bar", "where": "X > 0.3999", "keyframes": keyframes}
    return {"object": [long_bar(own, r.uniform(800, 1200))], "holder": [holder], **more}


def pulled(times: float) -> list[Table]:
    """To so many lengths in 1 s, held for 0.5 s, and back in 1 s."""
    away = {"translate": [0.4 * (times - 1), 0, 0]}
    return [{"time": 0}, {"time": 1, **away}, {"time": 1.5, **away}, {"time": 2.5}]


STILL: list[Table] = [{"time": 0}, {"time": 1}]


def turned(turns: int) -> list[Table]:
    """So many turns about the bar in 2 s, held for 0.5 s, and back in 2 s."""
    there = [{"time": 2 * k / (4 * turns), "rotate": [90.0 * k, 0, 0]} for k in range(4 * turns + 1)]
    return [*there, *({"time": 4.5 - each["time"], "rotate": each["rotate"]} for each in reversed(there))]


def pressed(r: Random) -> Table:
    """A cube on the floor under a ram that leaves a tenth of it, and goes up again."""
    heights = ((0, 0.2), (0.5, 0.0125), (0.6, 0.0125), (0.8, 0.5))
    frames = [{"time": t, "translate": [0, y, 0]} for t, y in heights]
    ram = {"name": "ram", "shape": "box", "size": [1, 0.002, 1], "keyframes": frames}
    cube = bar((3, 3, 3), (0.1, 0.1, 0.1), name="cube", young=None, density=r.uniform(500, 2000))
    cube |= {"pose": {"translate": [0, 0.002, 0]}, "effects": DAMPED | STABLE | {"touch": {"max_force": 1e3}}}
    return {"object": [cube], "obstacle": [{"name": "floor", "shape": "plane"}, ram],
            "effects": GRAVITY | {"contact": {}}, "dt": 0.005}  # fmt: skip


def on_the_floor(r: Random) -> Table:
    """The same cube without the ram."""
    table = pressed(r)
    return table | {"obstacle": table["obstacle"][:1]}


def poke(sim: Simulation, step: int) -> None:
    """1000 N on a corner of the cube for 0.1 s, its weight a hundred times."""
    if step == 20:
        assert sim.touch is not None
        x, y, z = sim.world.x.max(axis=0).tolist()
        sim.touch.push("test", "cube", (x, y, z), 0.0, (0, -1000.0, 0), 0.1)


TEETH = [
    {"name": f"tooth{k}", "shape": "box", "size": [0.05, 0.05, 1], "friction": 0.0,
     "pose": {"rotate": [0, 0, 45], "translate": [0.0707 * k, 0, 0]}} for k in range(10)
]  # fmt: skip


def sliding(r: Random) -> Table:
    """A cube that slides over a saw of ten teeth, as deep as a third of it."""
    cube = bar((3, 3, 3), (0.1, 0.1, 0.1), name="cube", young=1e5, density=r.uniform(500, 2000))
    cube["effects"] |= {"touch": True}
    return {"object": [cube | {"pose": {"translate": [0, 0.045, 0]}, "friction": 0.0}], "obstacle": TEETH,
            "effects": GRAVITY | {"contact": {}}}  # fmt: skip


def thrown_along(sim: Simulation, random: Random) -> None:
    """At 3 m/s along the saw."""
    v = sim.world.v.copy()
    v[:] = [3 + random.uniform(-0.5, 0.5), 0, 0]
    put(sim, sim.world.v, v)


def column(r: Random, law: Table, times: float, scheme: Table) -> Table:
    """A column that stands on its held end, under so many times its critical weight (Greenhill, 7.837 E I / L^3)."""
    young, width, length = 1e5, 0.05, 0.5
    density = times * 7.837 * young * width**4 / 12 / length**3 / (9.81 * width**2)
    found = bar((2, 10, 2), (width, length, width), name="column", young=None, density=density,
                pose={"rotate": [r.uniform(-1, 1), 0, r.uniform(-1, 1)]})  # fmt: skip
    found["effects"] = {"rayleigh": {"mass": 2.0}, "fixed": {"where": "Y < 1e-4"}} | law
    return {"object": [found], "effects": GRAVITY, "integrator": scheme}


LAWS: dict[str, Table] = {
    "corotational": {"corotational": {"young": 1e5, "poisson": 0.3}},
    "st_venant_kirchhoff": {"st_venant_kirchhoff": {"young": 1e5, "poisson": 0.3}},
    "mass_spring": {"mass_spring": {"young": 1e5}},
}


def hands(count: int) -> Callable[[Simulation, int], None]:
    """So many clients, each of which pushes another node with another force in every step."""

    def act(sim: Simulation, step: int) -> None:
        assert sim.touch is not None
        random, nodes = np.random.default_rng(step), sim.world.x[sim.world.free > 0]
        for k in range(count):
            x, y, z = random.choice(nodes).tolist()
            fx, fy, fz = random.uniform(-5, 5, 3).tolist()
            sim.touch.push(f"client{k}", "bar", (x, y, z), 0.0, (fx, fy, fz), sim.world.dt)

    return act


def posed(r: Random) -> Table:
    """A bar turned at random, and as it stands: two objects, loaded alike."""
    turn = r.uniform(-180, 180, 3).tolist()
    own = {"corotational": {"young": 1e5, "poisson": 0.45}}
    straight, other = (long_bar(own, name=name) for name in ("straight", "turned"))
    pull: Table = {"where": "X > 0.3999", "force": [0, -20.0, 0]}
    straight["effects"] |= {"traction": pull}
    other["pose"] = {"rotate": turn, "translate": [0, 2, 0]}
    other["effects"] |= {
        "traction": pull | {"force": Rotation.from_euler("xyz", turn, degrees=True).apply(pull["force"]).tolist()}
    }
    return {"object": [straight, other], "solver": {"update": "lockstep-10"}}


def more_iterations(sim: Simulation, trace: Trace) -> float:
    """Of the body that is turned over those of the other one, less one, as a size."""
    found = trace.records[trace.records["step"] > 20]
    straight, other = (found["iterations"][found["body"] == k].mean() for k in (0, 1))
    return abs(float(other / straight) - 1)


RECIPES = [
    EffectCase(
        "pulled to ten lengths",
        "by its end in 1 s, held, and brought back",
        REST,
        lambda r: held_at_the_end(STABLE, pulled(10), r),
        back_to_rest,
        1e-3,
        450,
        easy=lambda r: held_at_the_end(STABLE, STILL, r),
    ),
    *(
        EffectCase(
            f"{turns} turns: {name}",
            "of its end in 2 s, held, and turned back",
            REST,
            lambda r, turns=turns, law=law: held_at_the_end(law, turned(turns), r),
            back_to_rest,
            1e-2,
            650,
            fails=turns > 4,
            note=KNOTTED if turns > 4 else "",
            easy=lambda r, law=law: held_at_the_end(law, STILL, r),
        )
        for turns in (4, 10)
        for name, law in (
            ("stable_neo_hookean", STABLE),
            ("corotational", {"corotational": {"young": 1e5, "poisson": 0.45}}),
        )
    ),
    EffectCase(
        "pressed to a tenth",
        "by a ram on the floor, which goes up again",
        "below the floor within, in m",
        pressed,
        below_floor,
        1e-3,
        300,
        unconverged={"contact": 60},
        easy=on_the_floor,
    ),
    EffectCase(
        "poked with 1000 N",
        "on one node of a cube on the floor, for 0.1 s",
        SPEED,
        on_the_floor,
        still,
        1e-2,
        300,
        act=poke,
        unconverged={"contact": 5},
    ),
    EffectCase(
        "a saw",
        "a cube slides at 3 m/s over ten teeth without friction",
        GIVEN,
        sliding,
        energy_rise,
        1.0,
        200,
        begin=thrown_along,
        unconverged={"contact": 20},
    ),
    *(
        EffectCase(
            f"a column: {name}" + (", Newton" if linearizations > 1 else f", {times} times"),
            f"under {times} times its critical weight: it buckles and falls over",
            GIVEN,
            lambda r, law=law, times=times, n=linearizations: column(r, law, times, {"linearizations": n}),
            energy_rise,
            1.0,
            300,
            unconverged={"max_linearizations": 300},
            easy=lambda r, law=law, n=linearizations: column(r, law, 0.1, {"linearizations": n}),
        )
        for name, law in LAWS.items()
        for times, linearizations in ((2, 1), (8, 1), (8, 10))
    ),
    EffectCase(
        "a pose",
        "turned at random, and the same force turned with it",
        "mean iterations change, as a part, by at most",
        posed,
        more_iterations,
        0.2,
        150,
    ),
    EffectCase(
        "fifty hands",
        "of clients, each of which pushes another node in every step with up to 8 N",
        GIVEN,
        lambda r: {
            "object": [
                long_bar(
                    {"corotational": {"young": 1e5, "poisson": 0.45}, "touch": {"max_interactions": 100}},
                    r.uniform(800, 1200),
                )
            ],
            "effects": GRAVITY,
        },
        energy_rise,
        1.0,
        150,
        act=hands(50),
    ),
]
