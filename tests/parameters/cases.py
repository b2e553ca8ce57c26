# SPDX-License-Identifier: MIT
"""Scenes with every live parameter, and other values of it."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from tempfile import mkdtemp
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from sim_server.parameters import toml
from sim_server.scene.model import Scene
from sim_server.scene.overrides import assign
from sim_server.simulation import Simulation
from tests.effects.hollow import INSIDE, box
from tests.scenes import mesh_file
from tests.state import put

FIXED = {"fixed": {"where": "X < 0.01"}}
BAR = {"bar": [3, 1, 1], "size": [1.5, 0.5, 0.5], "split": "kuhn"}
REGIONS = [{"where": "X < 0.7", "young": 2e5}, {"young": 5e4, "poisson": 0.2}]
NAMED = [{"where": "X < 0.7", "young": 2e5, "name": "tumour"}, {"young": 5e4, "poisson": 0.2, "name": "rest"}]
YOUNG = {"young": 1e5, "poisson": 0.3}
STRETCHED = {"direction": [[1, 0, 0], [0, 1, 0]]}
LOADS = {"where": "X > 1.49", "force": [0, 30, 0], "stress": [5, 0, 0], "pressure": 40.0, "moment": [0, 9, 3]}


BEATS = {"stress": 3e4, "direction": [1, 1, 0], "activation": 0.7, "period": 0.1, "phase": 0.2, "duty": 0.8,
         "optimum": 1.1, "width": 0.6}  # fmt: skip


PATH = [[0.0, 0.0, 0.0], [0.5, 0.5, 0.0], [1.0, 0.5, 0.5], [1.5, 0.0, 0.5]]


class Case(NamedTuple):
    """A bar with effects, and what is set. `start` says that it is set before the first step, since what follows
    depends on more than positions and velocities."""

    effects: dict[str, Any]
    values: dict[str, Any]  # by key; a scene with them has the same steps
    scene: Mapping[str, Any] = MappingProxyType({})
    start: bool = False


def law(name: str, given: dict[str, Any], **values: Any) -> Case:
    """A bar of one law."""
    return Case({name: given}, {f"bar.{name}.{key}": value for key, value in values.items()})


COSTA = {f"b_{k}": 2.0 for k in ("ff", "fs", "fn", "ss", "sn", "nn")}
SPRINGS = {"springs": [[k, k + 1] for k in range(12)], "stiffness": 900.0, "rest_length": 0.4}
PAIR = {"between": ["bar", "floor"], "value": 0.3}
CONTACT = {
    "effects": {"gravity": {"g": [0, -9.81, 0]}, "contact": {"friction": [PAIR], "thickness": 0.02}},
    "obstacle": [{"name": "floor", "shape": "plane", "pose": {"rotate": [0, 0, -20], "translate": [0, -0.3, 0]}},
                 {"name": "wall", "shape": "plane", "pose": {"rotate": [0, 0, 15], "translate": [0, -0.2, 0]}}],
}  # fmt: skip
CASES = {
    "corotational": law("corotational", YOUNG, young=3e4, poisson=0.4),
    "exact": law("corotational", YOUNG | {"tangent": "exact"}, young=4e5),
    "qr": law("corotational", YOUNG | {"rotation": "qr"}, young=4e5),
    "regions": law("corotational", YOUNG | {"young": REGIONS}, young=[REGIONS[0], {"young": 3e5}]),
    "a region": law("corotational", YOUNG | {"young": NAMED}, **{"poisson[tumour]": 0.45, "young[tumour]": 4e5}),
    "a region of a law": law("neo_hookean", YOUNG | {"young": NAMED}, **{"poisson[rest]": 0.45}),
    "springs": law("mass_spring", SPRINGS, stiffness=500.0, rest_length=0.3),
    "edges": law("mass_spring", {"young": 1e5}, young=2e4),
    "st_venant_kirchhoff": law("st_venant_kirchhoff", YOUNG, young=3e5, poisson=0.2),
    "neo_hookean": law("neo_hookean", YOUNG, young=3e5, poisson=0.2),
    "stable_neo_hookean": law("stable_neo_hookean", YOUNG, young=3e5, poisson=0.2),
    "mooney_rivlin": law("mooney_rivlin", {"c1": 2e4, "c2": 1e4, "bulk": 1e5}, c1=3e4, c2=2e4, bulk=3e5),
    "veronda_westmann": law("veronda_westmann", {"c1": 2e4, "c2": 1.0, "bulk": 1e5}, c1=3e4, c2=1.5, bulk=2e5),
    "arruda_boyce": law(
        "arruda_boyce", {"shear": 3e4, "segments": 8.0, "bulk": 1e5}, shear=5e4, segments=12.0, bulk=2e5
    ),
    "ogden": law("ogden", {"mu": [3e4], "alpha": [2.0], "bulk": 1e5}, mu=[2e4, -1e4], alpha=[2.0, -2.0], bulk=2e5),
    "costa": law("costa", COSTA | {"a": 2e4, "bulk": 1e5, "fibre": [1, 0, 0], "sheet": [0, 1, 0]},
                 **{key: 3.0 for key in COSTA}, a=3e4, bulk=2e5, fibre=[0, 1, 0.5], sheet=[0, 0, 1]),
    "fibres": Case({"corotational": YOUNG, "fibres": {"stiffness": 2e4} | STRETCHED},
                   {"bar.fibres.stiffness": 9e4, "bar.fibres.exponent": 2.0, "bar.fibres.direction": [0, 1, 1]}),
    "cutting": Case({"corotational": YOUNG, "cutting": {"tear": 2.0}},
                    {"bar.cutting.removed": "0 9-12 15", "bar.cutting.tear": 3.0}),
    "split": Case({"corotational": YOUNG, "cutting": {"spare": 40}}, {"bar.cutting.opened": "3 17-22 41; 60-70"},
                  MappingProxyType({}), True),
    "split law": Case({"neo_hookean": YOUNG, "cutting": {"spare": 40}}, {"bar.cutting.opened": "3 17-22 41; 60-70"},
                  MappingProxyType({}), True),
    "cut springs": Case({"mass_spring": {"young": 1e5}, "cutting": {"removed": "2"}}, {"bar.cutting.removed": "3 5"}),
    "cut law": Case({"neo_hookean": YOUNG, "cutting": True}, {"bar.cutting.removed": "0 9-12 15"}),
    "cut fibres": Case({"corotational": YOUNG, "fibres": {"stiffness": 2e4} | STRETCHED, "cutting": True},
                       {"bar.cutting.removed": "0 9-12 15"}),
    "prony": Case({"corotational": YOUNG, "prony": {"terms": [{"g": 1.5, "tau": 1e4}], "shear": 3e4}},
                  {"bar.prony.shear": 2e5, "bar.corotational.young": 2e5}, MappingProxyType({}), True),
    "plasticity": Case({"corotational": YOUNG, "plasticity": {"yield_stress": 1e9}},
                       {"bar.plasticity.yield_stress": 700.0, "bar.plasticity.hardening": 1e3,
                        "bar.plasticity.kinematic": 2e3}, start=True),
    "damage": Case({"corotational": YOUNG, "damage": {"strength": 1e6, "fracture_energy": 1e9}},
                   {"bar.damage.strength": 500.0, "bar.damage.fracture_energy": 100.0}),
    "rayleigh": Case({"corotational": YOUNG, "rayleigh": {"mass": 0.1}},
                     {"bar.rayleigh.mass": 3.0, "bar.rayleigh.stiffness": 0.02}),
    "traction": Case({"corotational": YOUNG, "traction": LOADS},
                     {"bar.traction.force": [9, 3, 0], "bar.traction.stress": [0, 90, 0],
                      "bar.traction.pressure": -60.0, "bar.traction.moment": [0, 4, -5]}),
    "muscle": Case({"corotational": YOUNG, "muscle": {"stress": 2e4, "direction": [1, 0, 0]}},
                   {f"bar.muscle.{key}": value for key, value in BEATS.items()}, start=True),
    "cavity": Case({"corotational": YOUNG, "cavity": {"where": INSIDE, "pressure": 90.0}},
                   {"bar.cavity.pressure": 200.0}),
    "gas": Case({"corotational": YOUNG, "cavity": {"where": INSIDE, "amount": 1.0, "ambient": 1e3}},
                {"bar.cavity.amount": 1.5}),
    "liquid": Case({"corotational": YOUNG, "cavity": {"where": INSIDE, "volume": 0.125, "bulk": 1e4}},
                   {"bar.cavity.volume": 0.13}),
    "cavities": Case({"corotational": YOUNG, "cavity": [{"where": INSIDE, "pressure": 90.0}]},
                     {"bar.cavity.tables": [{"where": INSIDE, "pressure": -30.0}]}),
    "growth": Case({"corotational": YOUNG, "growth": {"expansion": 0.1}},
                   {"bar.growth.expansion": [0.2, 0.1, 0], "bar.growth.amount": 0.5}),
    "growth of a law": Case(
        {"neo_hookean": YOUNG, "fibres": {"stiffness": 2e4} | STRETCHED, "growth": {"expansion": 0.1}},
        {"bar.growth.amount": 2.0},
    ),
    "wind": Case({"corotational": YOUNG, "wind": {"velocity": [3, 0, 0]}},
                 {"bar.wind.velocity": [0, 5, 1], "bar.wind.density": 900.0, "bar.wind.drag": 0.7,
                  "bar.wind.friction": 0.1}),
    "buoyancy": Case({"corotational": YOUNG, "buoyancy": {"level": 0.2}},
                     {"bar.buoyancy.level": 0.4, "bar.buoyancy.density": 900.0}),
    "target": Case({"corotational": YOUNG, "target": {"to": ["X", "Y + 0.2 * X", "Z"], "stiffness": 1e3}},
                   {"bar.target.stiffness": 3e3, "bar.target.blend": 0.5}),
    "cable": Case({"corotational": YOUNG, "cable": {"path": PATH, "tension": 40.0}}, {"bar.cable.tension": 90.0}),
    "cable drawn in": Case({"corotational": YOUNG, "cable": {"path": PATH, "stiffness": 1e4, "shortening": 0.0}},
                           {"bar.cable.shortening": 0.02}),
    "cables": Case({"corotational": YOUNG, "cable": [{"path": PATH, "tension": 40.0}]},
                   {"bar.cable.tables": [{"path": PATH, "tension": 9.0}]}),
    "rod": Case({"corotational": YOUNG, "rod": {"path": PATH, "young": 1e8, "radius": 0.02}},
                {"bar.rod.young": 3e8, "bar.rod.prestretch": 1.2}),
    "rods": Case({"corotational": YOUNG, "rod": [{"path": PATH, "young": 1e8, "radius": 0.02}]},
                 {"bar.rod.tables": [{"path": PATH, "young": 3e8, "radius": 0.02, "prestretch": 0.9}]}),
    "membrane": Case({"corotational": YOUNG, "membrane": {"young": 1e6, "poisson": 0.3, "thickness": 0.01}},
                     {"bar.membrane.young": 3e6, "bar.membrane.poisson": 0.5, "bar.membrane.thickness": 0.02,
                      "bar.membrane.prestretch": 1.2}),
    "gravity": law("corotational", YOUNG)._replace(values={"gravity.g": [4.0, 1.0, 0.0]}),
    "friction": Case({"corotational": YOUNG}, {"bar.friction": 0.2, "floor.friction": 0.1, "wall.friction": 0.3,
                     "contact.friction": [PAIR | {"value": 0.9}], "gravity.g": [1, -9, 0]}, CONTACT, True),
}  # fmt: skip
EVERYTHING = {"bar.corotational.young": 3e4, "bar.rayleigh.mass": 3.0, "bar.rayleigh.stiffness": 0.02,
              "gravity.g": [4, 1, 0]}  # fmt: skip
for scheme in ("newmark", "bdf2", "generalized_alpha", "ros2", "central_difference"):
    values = {key: value for key, value in EVERYTHING.items() if scheme != "central_difference" or "stiff" not in key}
    CASES[scheme] = Case({"corotational": YOUNG, "rayleigh": {"mass": 0.1, "stiffness": 0.01}}, values,
                         {"integrator": {"scheme": scheme}}, True)  # fmt: skip
CASES["factor"] = CASES["ros2"]._replace(  # which is there with no worker only in the lists of launches
    scene={"integrator": {"scheme": "ros2"}, "solver": {"preconditioner": "cholesky"}}
)
HAND = {"name": "hand", "object": "bar", "where": "X > 1.4",
        "keyframes": [{"time": 0.0}, {"time": 0.1, "translate": [0, 0.05, 0]}]}  # fmt: skip
CASES["holder"] = CASES["generalized_alpha"]._replace(
    scene={"integrator": {"scheme": "generalized_alpha"}, "holder": [HAND]},
)
CASES["quasi_static"] = law("neo_hookean", YOUNG, young=3e5)._replace(
    scene={"integrator": {"scheme": "quasi_static"}}, start=True
)
CASES["linearizations"] = CASES["newmark"]._replace(scene={"integrator": {"linearizations": 4}})
CASES["contact"] = CASES["friction"]._replace(
    effects={"corotational": YOUNG, "rayleigh": {"mass": 0.1}},
    values={"bar.corotational.young": 2e5, "bar.rayleigh.stiffness": 0.01, "bar.rayleigh.mass": 0.3},
)


@cache
def hollow_mesh() -> dict[str, str]:
    """The `mesh` table of a box with a cavity."""
    return mesh_file(Path(mkdtemp()), *box())


def table(case: Case) -> dict[str, Any]:
    """The scene of a case."""
    effects = case.effects if "obstacle" in case.scene else case.effects | FIXED
    mesh = hollow_mesh() if "cavity" in effects else BAR
    explicit = case.scene.get("integrator", {}).get("scheme") == "central_difference"
    return {
        "name": "case", "dt": 0.01, "effects": {"gravity": {"g": [0, -9.81, 0]}},
        "solver": {"preconditioner": "none" if explicit else "block_jacobi", "warm_start": False},
        "object": [{"name": "bar", "mesh": mesh, "effects": effects}], **case.scene,
    }  # fmt: skip


def with_values(case: Case) -> dict[str, Any]:
    """The same scene with the other values from the start."""
    found = table(case)
    scene = Scene.model_validate(found).resolved()
    for key, value in case.values.items():
        name, *path = key.split(".")
        tables = {t["name"]: t for kind in ("object", "obstacle") for t in scene.get(kind, [])}
        inside = tables.get(name, {"effects": {name: scene["effects"].get(name)}})
        path = path if name in tables else [name, *path]
        assign(path[-1], value, "", inside["effects"][path[0]] if len(path) == 2 else inside)
    return scene


def texts(case: Case) -> dict[str, str]:
    """Its values as commands have them."""
    return {key: toml(value) for key, value in case.values.items()}


def both(case: Case, device: str = "cpu", steps: int = 6) -> tuple[Simulation, Simulation]:
    """A simulation in which the values were set, and one that had them from the start, after the same steps."""
    one = Simulation(Scene.model_validate(table(case)), device)
    other = Simulation(Scene.model_validate(with_values(case)), device)
    if not case.start:
        one.engine.run(5)
        one.fetch()
        put(other, other.world.x, one.world.x)
        put(other, other.world.v, one.world.v)
    one.parameters.set(texts(case))
    for simulation in (one, other):
        simulation.engine.run(steps)
        simulation.fetch()
    return one, other


def same(one: Simulation, other: Simulation) -> bool:
    """Whether positions and velocities are the same, bit for bit."""
    pairs = ((one.world.x, other.world.x), (one.world.v, other.world.v))
    return all(np.array_equal(a, b) for a, b in pairs)
