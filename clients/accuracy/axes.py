# SPDX-License-Identifier: MIT
"""Which settings of a scene are worth a point, the most telling ones first."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from clients.accuracy.points import Settings

TOLERANCES = ("1e-2", "1e-1", "1e-4", "1e-3", "1e-6")
LINEARIZATIONS = (2, 4)
EXACT = "1e-9"  # relative residual that counts as exact, of linear systems and of steps
MANY = 20  # linearizations that a step solved exactly may take, or the scene's own if these are more
EXACT_POSITION = "1e-12"  # m; a bound that counts as exact
ITERATIONS = "100000"  # that a solve which counts as exact may take
LONG = "1e9"  # ms of wall time; a budget of a step that never ends one
STEPS = (0.5, 2.0, 0.25, 4.0, 0.125)  # over the scene's dt
COARSEST = 4  # largest one of STEPS: the interval between compared times is a multiple of it
SCHEMES = ("bdf2", "newmark", "generalized_alpha", "ros2", "central_difference", "backward_euler")
SCHEMES_AND_STEPS = (
    ("bdf2", 0.5), ("newmark", 0.5), ("generalized_alpha", 0.5), ("ros2", 0.5), ("bdf2", 2.0), ("newmark", 0.25),
)  # fmt: skip
AGES = (1, 10, 30)  # steps; by every-N, whose times hold those of its factorizations, as those of lockstep-N do not
DROPS = ("1e-3", "1e-2", "1e-1")
POSITIONS = (1e-3, 1e-4, 1e-2, 1e-5)  # over the size of the largest object
LAWS = ("stable_neo_hookean", "corotational", "neo_hookean", "st_venant_kirchhoff")  # with young and poisson
FACTORS = ("auto", "cholesky", "incomplete_cholesky", "ssor_factor")  # preconditioners that workers make
REFINED, COARSENED = 12.0, 0.2  # time of a mesh with half, and with twice the size of elements


@dataclass(frozen=True)
class Candidate:
    """Settings worth a point. cost: expected time of its steps over that of the scene's."""

    axis: str
    settings: Settings
    cost: float = 1.0


@dataclass(frozen=True)
class SceneValues:
    """A resolved scene, as a log has it, on a device ("cpu" or "gpu")."""

    table: dict[str, Any]
    device: str

    @property
    def dt(self) -> float:
        return float(self.table["dt"])

    @property
    def solver(self) -> dict[str, Any]:
        return dict(self.table.get("solver", {}))

    @property
    def integrator(self) -> dict[str, Any]:
        return dict(self.table.get("integrator", {}))

    @property
    def scheme(self) -> str:
        return str(self.integrator["scheme"])

    @property
    def explicit(self) -> bool:
        return self.scheme == "central_difference"

    @property
    def bounds_position(self) -> bool:
        """True if the scene has a table [accuracy]."""
        return "accuracy" in self.table

    def wants_workers(self, settings: Settings) -> bool:
        """True if a run at `settings` is helped by workers."""
        scheme = settings.get("integrator.scheme", settings.get("integrator", self.scheme))
        kind = settings.get("solver.preconditioner", self.solver.get("preconditioner"))
        update = settings.get("solver.update", self.solver.get("update", "async"))
        return kind in FACTORS and "central_difference" not in scheme and not update.startswith("every-")

    def own(self) -> Settings:
        """Returns what the scene itself has for the keys that the joined points of an axis differ in."""
        keys = ("solver.tolerance", "integrator.linearizations", "integrator.scheme", "solver.preconditioner")
        found = {"dt": f"{self.dt:.12g}"}
        for key in keys:
            table, name = key.split(".")
            if name in self.table.get(table, {}):
                found[key] = _bare(self.table[table][name])
        return found

    def step(self, factor: float) -> Settings:
        """Returns the setting of a time step, over the scene's."""
        return {"dt": f"{self.dt * factor:.12g}"}

    def with_scheme(self, scheme: str, **others: Any) -> Settings:
        """Returns the settings of a scheme and other keys of [integrator].

        The whole table is set where the scene's has keys that belong to its own scheme.
        """
        kept = {"linearizations", "tolerance", "trials", "scheme"}
        given = {"scheme": scheme, **others}
        own = {key for key, value in self.integrator.items() if key not in kept and (key, value) != ("solve", "auto")}
        if scheme == self.scheme or not own:
            return {f"integrator.{key}": _bare(value) for key, value in given.items()}
        given = {key: self.integrator[key] for key in sorted(kept - {"scheme"}) if key in self.integrator} | given
        return {"integrator": toml(given)}

    def exact_solves(self) -> Settings:
        """Settings with which linear systems are solved exactly; {} where there are none, or none apart."""
        if self.explicit or self.bounds_position:
            return {}
        found = {"solver.tolerance": EXACT, "solver.max_iterations": ITERATIONS}
        if self.scheme == "ros2":
            found["integrator.solve"] = "iterate"
        return found | self._without_budget()

    def exact_steps(self) -> Settings:
        """Settings with which the equations of a step are solved exactly; {} where that takes no linearizations."""
        if self.explicit or self.scheme == "ros2":
            return {}
        found = self.exact_solves()
        if self.bounds_position:
            found = {"accuracy.position": EXACT_POSITION, "solver.tolerance": EXACT}
            found |= {"solver.max_iterations": ITERATIONS} | self._without_budget()
        return found | {"integrator.linearizations": str(self._many), "integrator.tolerance": EXACT}

    def references(self, parts: int) -> list[Settings]:
        """Returns settings of a reference with time steps of dt / parts; the first ones that work are to be taken.

        BDF2 solved exactly; where the scene has what refuses it, fewer linearizations or the scene's own scheme.
        """
        solver = {"solver.tolerance": EXACT, "solver.max_iterations": ITERATIONS}
        solver |= {"solver.preconditioner": "block_jacobi"} | self._without_budget()
        if self.solver.get("precision", "float64") != "float64":
            solver["solver.precision"] = "float64"
        if self.bounds_position:
            solver["accuracy.position"] = EXACT_POSITION
        common = self.step(1 / parts) | solver
        many = {"linearizations": self._many, "tolerance": float(EXACT)}
        if self.scheme == "quasi_static":
            return [common | self.with_scheme("quasi_static", **many)]
        own = "backward_euler" if self.scheme in ("ros2", "central_difference") else self.scheme
        last = {"linearizations": 1}
        found = [self.with_scheme("bdf2", **many), self.with_scheme("bdf2", **last)]
        found += [self.with_scheme(own, **many), self.with_scheme(own, **last)]
        return [common | settings for settings in found]

    @property
    def _many(self) -> int:
        return max(MANY, int(self.integrator["linearizations"]))

    def _without_budget(self) -> Settings:
        """Returns settings with which no wall time ends a solve or a step."""
        found = {}
        if self.solver.get("budget"):
            found["solver.budget"] = "0"
        if self.solver.get("budget_ms"):
            found["solver.budget_ms"] = LONG
        return found


def candidates(scene: SceneValues, size: float) -> list[Candidate]:
    """Returns the points to measure beside the scene itself, the most telling ones first. size: of an object [m]."""
    given = [*_first(scene), *_single(scene, size), *_pairs(scene, size), *_factors(scene)]
    found: list[Candidate] = []
    for each in given:
        if each.settings and all(each.settings != other.settings for other in found):
            found.append(each)
    return found


def left_out(scene: SceneValues) -> Iterator[tuple[str, str]]:
    """Yields axes that the scene does not have, and why."""
    if scene.explicit:
        for axis in ("tolerance", "linearizations", "preconditioner", "position"):
            yield axis, "central_difference solves no equations"
    if scene.bounds_position:
        yield (
            "tolerance",
            "the scene bounds the error by [accuracy]; what is left of the linear solve is in the linearization",
        )
    if scene.scheme == "quasi_static":
        yield "scheme", "a quasi-static scene is no motion that another scheme could make"
    if not _bars(scene):
        yield "mesh", "no object has a mesh that is a bar, which could be refined"
    if not list(_models(scene)):
        yield "model", "no object has a law with young and poisson alone, which another law could take over"
    if scene.device == "cpu":
        yield "precision", "a CPU has float64 only"
    else:
        yield "drop tolerance", "incomplete factors are for a CPU"


def _first(scene: SceneValues) -> Iterator[Candidate]:
    """Yields what the errors by source are made of."""
    yield Candidate("tolerance", scene.exact_solves(), 3)
    yield Candidate("linearizations", scene.exact_steps(), 8)


def _single(scene: SceneValues, size: float) -> Iterator[Candidate]:
    """Yields points of which one setting differs, the axes in turn so that each has a point early."""
    solves = not scene.explicit
    tolerances, linearizations = list(_tolerances(scene)), list(_linearizations(scene))
    positions = [Candidate("position", {"accuracy.position": f"{size * p:.1g}"}) for p in POSITIONS if solves]
    steps = [Candidate("time step", scene.step(factor), 1 / factor) for factor in STEPS]
    schemes = list(_schemes(scene))
    yield from (*tolerances[:1], *linearizations[:1], *steps[:2], *schemes[:1], *positions[:1])
    yield from _meshes(scene)
    yield from list(_models(scene))[:1]
    yield from (*tolerances[1:3], *steps[2:4], *schemes[1:], *positions[1:], *linearizations[1:], *tolerances[3:])
    yield from steps[4:]


def _tolerances(scene: SceneValues) -> Iterator[Candidate]:
    if scene.explicit or scene.bounds_position:
        return
    for tolerance in TOLERANCES:
        if float(tolerance) != scene.solver.get("tolerance"):
            yield Candidate("tolerance", {"solver.tolerance": tolerance})


def _linearizations(scene: SceneValues) -> Iterator[Candidate]:
    if scene.explicit or scene.scheme == "ros2":
        return
    for number in (1, *LINEARIZATIONS):
        if number != scene.integrator["linearizations"]:
            yield Candidate("linearizations", {"integrator.linearizations": str(number)}, number)


def _schemes(scene: SceneValues) -> Iterator[Candidate]:
    for scheme in SCHEMES:
        if scheme != scene.scheme and scene.scheme != "quasi_static":
            yield Candidate("scheme", _scheme(scene, scheme), 1.5)


def _scheme(scene: SceneValues, scheme: str) -> Settings:
    single = scheme in ("ros2", "central_difference") and scene.integrator["linearizations"] > 1
    found = scene.with_scheme(scheme, **({"linearizations": 1} if single else {}))
    if scheme == "central_difference" and scene.solver.get("preconditioner") not in ("auto", "none"):
        found["solver.preconditioner"] = "auto"
    if scene.explicit and scene.solver.get("preconditioner") == "none":
        found["solver.preconditioner"] = "auto"  # a scene without solves may have none
    return found


def _pairs(scene: SceneValues, size: float) -> Iterator[Candidate]:
    if not scene.explicit and not scene.bounds_position:
        if scene.scheme != "ros2":
            for number, tolerance in ((2, "1e-2"), (2, "1e-1"), (4, "1e-1")):
                both = {"integrator.linearizations": str(number), "solver.tolerance": tolerance}
                yield Candidate("linearizations and tolerance", both, number)
        for factor in (0.5, 0.25):
            yield Candidate("time step and tolerance", scene.step(factor) | {"solver.tolerance": "1e-2"}, 1 / factor)
    for factor in (0.5, 0.25) if not scene.explicit else ():
        both = scene.step(factor) | {"accuracy.position": f"{size * POSITIONS[0]:.1g}"}
        yield Candidate("time step and position", both, 1 / factor)
    if scene.scheme == "quasi_static":
        return
    for scheme, factor in SCHEMES_AND_STEPS:
        if scheme != scene.scheme:
            yield Candidate("scheme and time step", _scheme(scene, scheme) | scene.step(factor), 1.5 / factor)


def _factors(scene: SceneValues) -> Iterator[Candidate]:
    """Yields preconditioners, precisions, ages and drop tolerances of factors: other times at about the same error."""
    if scene.explicit:
        return
    cholesky = {"solver.preconditioner": "cholesky"}
    for kind in ("block_jacobi", "cholesky"):
        if kind != scene.solver.get("preconditioner"):
            yield Candidate("preconditioner", {"solver.preconditioner": kind})
    for age in AGES:
        yield Candidate("factor age", cholesky | {"solver.update": f"every-{age}"}, 3)
    if scene.device == "cpu":
        double = {"solver.update": "every-10", "solver.factor_precision": "float64"}
        yield Candidate("factor precision", cholesky | double, 3)
        for drop in DROPS:
            incomplete = {"solver.preconditioner": "incomplete_cholesky", "solver.drop_tolerance": drop}
            yield Candidate("drop tolerance", incomplete, 2)
        return
    for precision in ("mixed", "float32", "float64"):
        if precision != scene.solver.get("precision", "float64"):
            yield Candidate("precision", {"solver.precision": precision})
    for precision in ("float16", "float32"):
        yield Candidate("factor precision", cholesky | {"solver.factor_precision": precision})


def _bars(scene: SceneValues) -> dict[str, list[int]]:
    """Returns the cells of objects whose mesh is a bar."""
    return {o["name"]: o["mesh"]["bar"] for o in scene.table["object"] if "bar" in o.get("mesh", {})}


def mesh_settings(scene: SceneValues, fine: bool) -> Settings:
    """Returns the settings that halve (or double) the size of all cells of bars; {} where that is impossible."""
    bars = _bars(scene)
    if not fine and any(count % 2 for cells in bars.values() for count in cells):
        return {}
    cells = {name: [2 * c if fine else c // 2 for c in counts] for name, counts in bars.items()}
    return {f"object.{name}.mesh.bar": toml(counts) for name, counts in cells.items()}


def _meshes(scene: SceneValues) -> Iterator[Candidate]:
    yield Candidate("mesh", mesh_settings(scene, fine=False), COARSENED)
    yield Candidate("mesh", mesh_settings(scene, fine=True), REFINED)


def _models(scene: SceneValues) -> Iterator[Candidate]:
    """Yields other laws of elasticity for all objects whose law has the same parameters."""
    for law in LAWS:
        settings: Settings = {}
        for o in scene.table["object"]:
            effects = o.get("effects", {})
            own = [name for name in LAWS if name in effects]
            if len(own) != 1 or own[0] == law:
                continue
            kept = {key: effects[own[0]][key] for key in ("young", "poisson") if key in effects[own[0]]}
            settings[f"object.{o['name']}.effects.{law}"] = toml(kept)
            settings[f"object.{o['name']}.effects.{own[0]}"] = "false"
        if settings:
            yield Candidate("model", settings, 2)


def toml(value: Any) -> str:
    """Writes a value of JSON as one of TOML on one line."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(toml(item) for item in value) + "]"
    return json.dumps(value)


def _bare(value: Any) -> str:
    return value if isinstance(value, str) else toml(value)
