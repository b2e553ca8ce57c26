# SPDX-License-Identifier: MIT
"""A sample of parameters for each effect, and scenes with and without it. Nothing of the server is imported here."""

import json
from dataclasses import dataclass, field
from itertools import permutations, product
from pathlib import Path
from typing import Any

Cells = tuple[int, int, int]
LAW: dict[str, Any] = {"young": 1e6, "poisson": 0.45}
HELD: dict[str, Any] = {"fixed": {"where": "Z < 0.001"}}
BASE: dict[str, Any] = HELD | {"corotational": LAW}
HYPERELASTIC: dict[str, Any] = HELD | {"neo_hookean": LAW}
LOAD: dict[str, Any] = {"where": "Z > 3.999", "force": [0, -100, 0]}
EVEN = ((0, 1, 2), (1, 2, 0), (2, 0, 1))  # permutations
BULK = 3e6  # Pa
INSIDE = "max(2 * max(abs(X - 0.5), abs(Y - 0.5)), abs(Z - 2) / 2) < 0.999"  # nodes of a hollow beam
FLOOR = '[[obstacle]]\nname = "floor"\nshape = "plane"\npose = { translate = [0, -5, 0] }\n'


@dataclass(frozen=True)
class Sample:
    """Parameters of an effect, and what a scene needs to list it.

    table: of the effect. scene: listed under [effects]
    beside, of_scene: effects of the object and of the scene, with it and without
    more: tables of the scene with it. elements: of the object, with it and without
    hollow: the beam is, with walls of one cell
    """

    table: Any
    scene: bool = False
    beside: dict[str, Any] = field(default_factory=lambda: BASE)
    of_scene: dict[str, Any] = field(default_factory=lambda: {"gravity": True})
    more: str = ""
    elements: str = "linear"
    hollow: bool = False


SAMPLES: dict[str, Sample] = {
    "arruda_boyce": Sample({"shear": 3e5, "segments": 8.0, "bulk": BULK}),
    "buoyancy": Sample({"level": -0.5}),
    "cable": Sample({"path": [[0.5, 0.5, 0], [0.5, 0.5, 2], [0.5, 0.5, 4]], "tension": 50}),
    "cavity": Sample({"where": INSIDE, "pressure": 100}, hollow=True),
    "contact": Sample(True, scene=True, more=FLOOR),
    "corotational": Sample(LAW, beside=HYPERELASTIC),
    "costa": Sample({"a": 1e5, "bulk": BULK, "fibre": [0, 0, 1], "sheet": [1, 0, 0]}),
    "cutting": Sample(True),
    "damage": Sample({"strength": 1e4, "fracture_energy": 100}),
    "fibres": Sample({"stiffness": 1e5, "exponent": 1.0, "direction": [0, 0, 1]}, beside=HYPERELASTIC),
    "fixed": Sample(HELD["fixed"], beside={"corotational": LAW}),
    "gravity": Sample(True, scene=True, beside=BASE | {"traction": LOAD}, of_scene={}),
    "growth": Sample({"expansion": 0.01}),
    "mass_spring": Sample({"young": 1e6}),
    "mooney_rivlin": Sample({"c1": 1.5e5, "c2": 2e4, "bulk": BULK}),
    "muscle": Sample({"stress": 1e3, "direction": [0, 0, 1]}),
    "neo_hookean": Sample(LAW),
    "ogden": Sample({"mu": [4e5, 1e4], "alpha": [1.3, 5.0], "bulk": BULK}),
    "plasticity": Sample({"yield_stress": 1e4}),
    "poroelasticity": Sample({"mobility": 1e-9, "storage": 1e6}),
    "prony": Sample({"terms": [{"g": 0.5, "tau": 0.1}]}),
    "rayleigh": Sample({"mass": 0.5, "stiffness": 0.01}),
    "st_venant_kirchhoff": Sample(LAW),
    "stable_neo_hookean": Sample(LAW),
    "target": Sample({"to": ["X", "Y", "Z + 0.1"], "stiffness": 1e4}),
    "touch": Sample(True),
    "traction": Sample(LOAD),
    "veronda_westmann": Sample({"c1": 8e4, "c2": 2.0, "bulk": BULK}),
    "wind": Sample({"velocity": [5, 0, 0]}),
}


def write_scene(
    path: Path, name: str, cells: Cells, listed: bool, solver: str = 'preconditioner = "block_jacobi"'
) -> None:
    """Writes a scene with a beam of 1 x 1 x 4 m: with the sample of an effect, or the same without it.

    solver: lines of [solver]
    """
    sample = SAMPLES[name]
    effects = sample.beside | ({name: sample.table} if listed and not sample.scene else {})
    of_scene = sample.of_scene | ({name: sample.table} if listed and sample.scene else {})
    mesh = f"bar = {list(cells)}, size = [1, 1, 4]"
    if sample.hollow:
        path.with_name("hollow.msh").write_text(hollow_beam(cells))
        mesh = 'file = "hollow.msh"'
    path.write_text("\n".join([
        "dt = 0.02", "[effects]", *_lines(of_scene), "[solver]", solver, "[[object]]", 'name = "beam"',
        f"mesh = {{ {mesh} }}", f'elements = "{sample.elements}"', "[object.effects]", *_lines(effects),
        sample.more if listed else "",
    ]))  # fmt: skip


def hollow_beam(cells: Cells) -> str:
    """Returns a mesh as Gmsh 2.2 writes it: cells along x, y, z, three at least, each of the wall in six tetrahedra."""
    counts = [max(3, n) for n in cells]
    tets: list[list[int]] = []
    number: dict[tuple[int, ...], int] = {}
    for cell in product(*map(range, counts)):
        if all(0 < at < n - 1 for at, n in zip(cell, counts, strict=True)):
            continue
        for order in permutations(range(3)):
            corners = [list(cell)]
            for axis in order:
                corners.append([at + (k == axis) for k, at in enumerate(corners[-1])])
            a, b, c, d = (number.setdefault(tuple(corner), len(number) + 1) for corner in corners)
            tets.append([a, b, c, d] if order in EVEN else [a, b, d, c])
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$Nodes", str(len(number))]
    for (i, j, k), n in number.items():
        lines.append(f"{n} {i / counts[0]!r} {j / counts[1]!r} {4 * k / counts[2]!r}")
    lines += ["$EndNodes", "$Elements", str(len(tets))]
    lines += [f"{n} 4 2 0 0 {a} {b} {c} {d}" for n, (a, b, c, d) in enumerate(tets, 1)]
    return "\n".join([*lines, "$EndElements", ""])


def _lines(tables: dict[str, Any]) -> list[str]:
    return [f"{name} = {toml(table)}" for name, table in tables.items()]


def toml(value: Any) -> str:
    """A value as TOML, tables inline."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(each)}" for key, each in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(toml, value)) + "]"
    return json.dumps(value)


def files_of(name: str, there: list[str], known: list[str]) -> list[str]:
    """Returns those files of sim_server/effects that are an effect's: its module and texts with its name in front.

    there: names of files; known: effects, as that of a text is the longest that it begins with
    """

    def owner(file: str) -> str:
        stem = file.split(".")[0]
        return max((e for e in known if f"{stem}_".startswith(f"{e}_")), key=len, default="")

    return [file for file in there if owner(file) == name]
