# SPDX-License-Identifier: MIT
"""Random small scenes, and what happens in them, as plans: tables that JSON can hold (run by random_runs.py).

A plan has the tables of a scene file, where a mesh may be `{ made = … }` (random_runs.made_mesh); `start`, the state
that it begins in; `source`, what makes factors; `events`, a list of [step, kind, values]; and `steps`.
"""

from typing import Any

from hypothesis import strategies as st

Table = dict[str, Any]
Draw = Any  # st.DrawFn

POISSON = (0.0, 0.3, 0.45, 0.49, 0.499)
SCHEMES = ("backward_euler", "newmark", "bdf2", "generalized_alpha", "ros2", "central_difference", "quasi_static")
KINDS = ("none", "jacobi", "block_jacobi", "ssor", "ssor_factor", "incomplete_cholesky", "cholesky", "auto")
IN_STEP, FREE = ("never", "every-3", "lockstep-2", "lockstep-7"), ("async", "adaptive")
SOURCES = ("inline", "negated", "noise", "shuffled", "ones", "nan", "overflow", "half")
LOSSY = ("nobody", "late", "lost", "earlier", "failing")  # of policies that do not wait
STARTS = ("rest", "thrown", "spun", "stretched", "flat", "mirrored", "random")
LAWS = (
    "corotational", "stable_neo_hookean", "neo_hookean", "st_venant_kirchhoff", "mass_spring", "mooney_rivlin",
    "arruda_boyce", "veronda_westmann", "ogden", "costa",
)  # fmt: skip
STIFFEN = {"arruda_boyce", "costa", "veronda_westmann"}  # without end: explicit steps have millions of substeps
MEMORY = ("prony", "plasticity", "damage")
ALONE = ("quasi_static", "central_difference")


def power(low: int, high: int) -> st.SearchStrategy[float]:
    """10 to an integer, smallest exponents first."""
    return st.sampled_from([10.0**e for e in sorted(range(low, high + 1), key=abs)])


def parts(whole: float, low: int, high: int) -> st.SearchStrategy[float]:
    """So much times 10 to an integer."""
    return power(low, high).map(lambda times: whole * times)


def direction() -> st.SearchStrategy[list[float]]:
    return st.sampled_from([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, -1.0, 0.5]])


@st.composite
def laws(draw: Draw, scheme: str) -> tuple[str, Table]:
    """An elastic law of about E, and its table."""
    young = 1e5 * draw(power(-3, 5 if scheme != "central_difference" else 2))
    elastic = {"young": young, "poisson": draw(st.sampled_from(POISSON))}
    bulk = young * draw(power(0, 3))
    name = draw(st.sampled_from(tuple(name for name in LAWS if scheme != "central_difference" or name not in STIFFEN)))
    if name == "corotational":
        return name, elastic | draw(
            st.sampled_from([{}, {"tangent": "exact"}, {"tangent": "usual"}, {"rotation": "qr"}])
        )
    if name == "neo_hookean":
        return name, elastic | draw(st.sampled_from([{}, {"inversion": "regularize"}]))
    return name, {
        "mass_spring": {"young": young}, "st_venant_kirchhoff": elastic, "stable_neo_hookean": elastic,
        "mooney_rivlin": {"c1": 0.15 * young, "c2": 0.02 * young, "bulk": bulk},
        "arruda_boyce": {"shear": 0.3 * young, "segments": 8.0, "bulk": bulk},
        "veronda_westmann": {"c1": 0.1 * young, "c2": 2.0, "bulk": bulk},
        "ogden": {"mu": [0.4 * young, 0.01 * young], "alpha": [1.3, 5.0], "bulk": bulk},
        "costa": {"a": 0.1 * young, "bulk": bulk, "fibre": [0, 0, 1], "sheet": [1, 0, 0]},
    }[name]  # fmt: skip


def beside(young: float, size: float, explicit: bool) -> dict[str, st.SearchStrategy[Any]]:
    """Tables of effects beside the law of an object of that size [m]; explicit: of schemes without solves."""
    force, one_of, table = young * size * size, st.sampled_from, st.fixed_dictionaries
    stiffness = (0.0, 1e-6, 1e-5) if explicit else (0.0, 1e-3, 1.0)  # substeps would be very short
    path = [[0, 0, 0], [size / 2, 0, 0], [size, 0, 0]]
    cables = [{"tension": force * 0.01}, {"stiffness": young * size, "shortening": size / 10}]
    return {
        "touch": st.just({"max_force": 1e6}),
        "fixed": st.just({"where": f"X < {0.01 * size:g}"}),
        "rayleigh": table({"mass": one_of((0.1, 0.0, 10.0)), "stiffness": one_of(stiffness)}),
        "fibres": table({"stiffness": st.just(young), "exponent": one_of((0.0, 1.0)), "direction": direction()}),
        "muscle": table({"stress": parts(young, -2, 2), "direction": direction(), "period": one_of((0.0, 0.05))}),
        "growth": table({"expansion": one_of((0.1, -0.5, 1.0)), "amount": one_of((1.0, 0.0))}),
        "traction": table({
            "where": st.just(f"X > {0.99 * size:g}"), "pressure": one_of((0.0, 0.01 * young, young)),
            "force": parts(force, -3, 0).map(lambda f: [0.0, f, 0.0]),
        }),
        "target": table({"to": st.just(["X", "Y + 0.2 * X", "Z"]), "stiffness": parts(young * size, -2, 2)}),
        "wind": table({"velocity": power(0, 3).map(lambda v: [v, 0.0, 1.0])}),
        "buoyancy": table({"level": one_of((0.5 * size, 0.0, 5 * size))}),
        "cable": one_of([{"path": path, **cable} for cable in cables]),
        "prony": table({"terms": power(-3, 1).map(lambda tau: [{"g": 0.5, "tau": tau}])}),
        "plasticity": table({"yield_stress": parts(young, -4, 0)}),
        "damage": table({"strength": parts(young, -4, 0), "fracture_energy": parts(young * size, -4, 0)}),
        "cutting": st.just(True),
    }  # fmt: skip


@st.composite
def others(draw: Draw, law: str, young: float, size: float, scheme: str) -> Table:
    """Effects beside the law of an object, at most four."""
    found = beside(young, size, scheme == "central_difference")
    chosen = draw(st.lists(st.sampled_from(sorted(found)), max_size=4, unique=True))
    if "cutting" in chosen:
        chosen = [name for name in chosen if name in ("cutting", "touch", "fixed", "rayleigh", "fibres")]
    memory = [name for name in chosen if name in MEMORY and (law == "corotational" or name == "prony")]
    kept = memory[: scheme not in ("ros2", "central_difference")]
    return {name: draw(found[name]) for name in chosen if name not in MEMORY or name in kept}


@st.composite
def bodies(draw: Draw, index: int, scheme: str) -> Table:
    """An [[object]], beside or above those before it."""
    size = 0.1 * draw(power(-1, 1))
    cells = draw(st.sampled_from([[1, 1, 1], [2, 1, 1], [2, 2, 2], [4, 1, 1], [3, 2, 1]]))
    mesh = {"bar": cells, "size": [size, size * draw(st.sampled_from((1.0, 0.5, 0.05))), size]}
    mesh["split"] = draw(st.sampled_from(("mirrored", "kuhn")))
    if draw(st.booleans()):
        sliver = 1.0 if scheme == "central_difference" else draw(st.sampled_from((1.0, 0.1, 1e-3)))
        mesh = {
            "made": {
                **mesh,
                "jitter": draw(st.sampled_from((0.0, 0.3))),
                "sliver": sliver,
                "seed": draw(st.integers(0, 9)),
            }
        }
    law, table = draw(laws(scheme))
    young = table.get("young", 1e5)
    effects = {law: table} | draw(others(law, young, size, scheme))
    if draw(st.integers(0, 9)) == 9:
        effects["corotational"] = {"young": young, "poisson": 0.3}
    kind = draw(st.sampled_from(("linear", "auto", "patch", "smoothed", "quadratic")))
    linear = {"prony", "plasticity", "damage", "cutting", "growth"} & effects.keys() or scheme == "central_difference"
    if linear or (kind != "patch" and "corotational" not in effects):
        kind = draw(st.sampled_from(("linear", "auto")))
    above = draw(st.booleans())
    place = [0.0, 0.002 + index * 1.2 * size, 0.0] if above else [index * 1.1 * size, 0.002, 0.0]
    return {
        "name": "abc"[index], "mesh": mesh, "density": draw(power(1, 4)), "effects": effects,
        "elements": kind,
        "pose": {"translate": place, "rotate": draw(st.sampled_from([[0, 0, 0], [30, 10, 0]]))},
    }  # fmt: skip


@st.composite
def solvers(draw: Draw, scheme: str) -> Table:
    """A [solver] table."""
    table: Table = {
        "preconditioner": draw(st.sampled_from(KINDS)),
        "update": draw(st.sampled_from(IN_STEP + FREE)),
        "tolerance": draw(st.sampled_from((1e-6, 1e-3, 1e-10, 1e-14))),
        "max_iterations": draw(st.sampled_from((500, 1, 3, 30, 5000))),
    }
    if scheme in ("ros2", "central_difference"):
        table["preconditioner"] = draw(st.sampled_from(("auto", "cholesky" if scheme == "ros2" else "none")))
    more: Table = {
        "warm_start": False, "warp": False, "on_runaway": draw(st.sampled_from(("go_on", "halve"))),
        "woodbury": draw(st.sampled_from((0, 1, 64))),
        "projection": draw(st.sampled_from(("clamp", "absolute", "excess", "none"))), "factor_precision": "float64",
        "warp_level": 2, "omega": 1.5,
    }  # fmt: skip
    return table | {name: more[name] for name in draw(st.lists(st.sampled_from(sorted(more)), max_size=2, unique=True))}


@st.composite
def integrators(draw: Draw) -> Table:
    """An [integrator] table."""
    scheme = draw(st.sampled_from(SCHEMES))
    table: Table = {"scheme": scheme}
    if scheme not in ("ros2", "central_difference"):
        table["linearizations"] = draw(st.sampled_from((1, 1, 2, 8)))
        if table["linearizations"] > 1:
            table["trials"] = draw(st.sampled_from((8, 0, 1)))
    if scheme == "ros2":
        table["solve"] = draw(st.sampled_from(("auto", "iterate", "factor")))
    return table


def obstacles() -> st.SearchStrategy[list[Table]]:
    floor = {"name": "floor", "shape": "plane", "friction": 0.5}
    ball = {"name": "ball", "shape": "sphere", "radius": 0.05, "moved": "client", "max_speed": 100.0,
            "pose": {"translate": [0.0, 0.5, 0.0]}}  # fmt: skip
    keys = [(0.0, [0.0, 2.0, 0.0], 0), (0.05, [0.0, 0.05, 0.0], 30), (0.1, [0.0, 1.0, 0.0], 0)]
    frames = [{"time": t, "translate": at, "rotate": [0, 0, turn]} for t, at, turn in keys]
    ram = {"name": "ram", "shape": "box", "size": [1.0, 0.02, 1.0], "keyframes": frames}
    return st.sampled_from([[floor], [floor, ball], [floor, ram], [ball, ram]])


@st.composite
def events(draw: Draw, names: list[str], steps: int) -> list[list[Any]]:
    """What clients do, by step."""
    unit = st.integers(0, 99)
    kinds = {
        "push": st.fixed_dictionaries({
            "object": st.sampled_from(names), "node": unit, "radius": st.sampled_from((0.0, 0.05, 10.0)),
            "force": direction(), "newton": power(-1, 7), "duration": st.sampled_from((0.05, 1e9)),
        }),
        "grab": st.fixed_dictionaries({
            "object": st.sampled_from(names), "node": unit, "radius": st.sampled_from((0.0, 0.05, 10.0)),
            "by": direction(), "far": power(-3, 2), "stiffness": power(0, 12), "newton": power(-1, 7),
            "duration": st.sampled_from((0.05, 1e9)),
        }),
        "release": st.just({}),
        "set": st.fixed_dictionaries({"key": unit, "times": st.sampled_from((0.5, 2.0, 0.0, -1.0, 1e-6, 1e6, 1e300))}),
        "cut": st.fixed_dictionaries({
            "object": st.sampled_from(names), "part": st.sampled_from((0.1, 0.5, 0.99, 1.0)), "seed": st.integers(0, 9),
        }),
        "move": st.fixed_dictionaries({"which": st.integers(0, 3), "by": direction(), "far": power(-2, 1)}),
        "reset": st.fixed_dictionaries({"object": st.sampled_from(["", *names])}),
        "nan": st.fixed_dictionaries({"object": st.sampled_from(names), "node": unit}),
    }  # fmt: skip
    found = []
    for _ in range(draw(st.integers(0, 4))):
        kind = draw(st.sampled_from(sorted(kinds)))
        found.append([draw(st.integers(0, steps - 1)), kind, draw(kinds[kind])])
    return sorted(found, key=lambda each: each[0])


@st.composite
def plans(draw: Draw) -> Table:
    """A scene and what happens in it."""
    integrator = draw(integrators())
    scheme = integrator["scheme"]
    solver = draw(solvers(scheme))
    objects = [draw(bodies(index, scheme)) for index in range(draw(st.sampled_from((1, 1, 2, 3))))]
    scene: Table = {
        "dt": draw(st.sampled_from((0.01, 0.001, 0.1, 1.0))), "effects": {"gravity": {"g": [0, -9.81, 0]}},
        "integrator": integrator, "solver": solver, "object": objects,
    }  # fmt: skip
    if scheme == "central_difference":
        scene["dt"] = 1e-5  # a step has as many substeps as it needs
    if scheme == "quasi_static":
        for each in objects:
            each["effects"].setdefault("fixed", {"where": "X < 1e-6"})
    if not draw(st.integers(0, 2)) and scheme not in ALONE:
        scene["obstacle"] = draw(obstacles())
        scene["effects"]["contact"] = draw(st.sampled_from([{}, {"self": True}, {"between": False}]))
    if not draw(st.integers(0, 4)):
        size = objects[0]["mesh"].get("made", objects[0]["mesh"])["size"][0]
        moved: Table = {"keyframes": [{"time": 0.0}, {"time": 0.1, "translate": [size, size, 0], "rotate": [90, 0, 0]}]}
        hand = {"name": "hand", "object": "a", "where": f"X > {0.99 * size:g}"}
        scene["holder"] = [hand | draw(st.sampled_from([moved, {"moved": "client", "max_speed": 100.0}]))]
    if len(objects) > 1 and not draw(st.integers(0, 2)) and scheme == "backward_euler":
        breaking = draw(st.sampled_from([{}, {"breaking": 1.0}]))
        scene["attachment"] = [{"name": "glue", "object": "b", "to": "a", "where": "true", "reach": 1.0} | breaking]
    if not draw(st.integers(0, 7)) and scheme != "central_difference":
        scene["accuracy"] = {"position": draw(st.sampled_from((1e-6, 1e-3, 1e-12)))}
    steps = draw(st.sampled_from((12, 6, 30)))
    names = [each["name"] for each in objects]
    sources = SOURCES + (LOSSY if solver["update"] in FREE else ())
    return {
        "scene": scene, "start": [draw(st.sampled_from(STARTS)), draw(st.integers(0, 9))],
        "source": draw(st.sampled_from(("inline", *sources))), "events": draw(events(names, steps)), "steps": steps,
    }  # fmt: skip
