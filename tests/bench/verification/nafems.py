# SPDX-License-Identifier: MIT
"""`bench verification`: stresses at a point of an elliptic membrane and of a thick plate (NAFEMS), by kind of elements.

Alone: `python -m tests.bench.verification.nafems`.
"""

import tempfile
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from numpy.typing import NDArray

from sim_server.mesh import bar as bar_mesh
from sim_server.simulation import Simulation
from tests.bench.verification.loads import settle, static_scene
from tests.bench.verification.locking import UNKNOWN, kinds, nodes_of
from tests.bench.verification.row import Row, relative

Reals = NDArray[np.float64]
Cells = tuple[int, int, int]  # from the inner ellipse to the outer one, around, over the thickness
INNER, OUTER = (2.0, 1.0), (3.25, 2.75)  # m, half axes
YOUNG, POISSON, SMALL = 210e9, 0.3, 1e-3  # Pa; part of the load: nothing but Hooke's law
DEGREE = 4  # of the polynomials that give the stress
SOURCE = "The Standard NAFEMS Benchmarks, 1990; ours by polynomials of degree 4 nearest to the displacements around D"
ON_OUTER = f"X*X/{OUTER[0] ** 2} + Y*Y/{OUTER[1] ** 2} > 0.99999"
SIDES = [{"where": "X < 1e-6", "along": "x"}, {"where": "Y < 1e-6", "along": "y"}]


def quarter(cells: Cells, thickness: float, kind: str, folder: Path) -> dict[str, str]:
    """Writes the mesh of a quarter of an elliptic ring, all its nodes on ellipses; returns the table of an object."""
    box = bar_mesh(cells, (1.0, 1.0, thickness), "mirrored")
    mesh = nodes_of(box.rest, box.tets, kind)
    out, angle = mesh.rest[:, 0], mesh.rest[:, 1] * np.pi / 2
    axes = np.outer(1 - out, INNER) + np.outer(out, OUTER)
    rest = np.column_stack([axes[:, 0] * np.cos(angle), axes[:, 1] * np.sin(angle), mesh.rest[:, 2]])
    rest[np.abs(rest) < 1e-12] = 0
    path = folder / "mesh.vtu"
    meshio.Mesh(rest, [("tetra10" if kind == "quadratic" else "tetra", mesh.tets)]).write(path)
    return {"file": str(path)}


def ring(cells: Cells, thickness: float, kind: str, fixed: list[dict[str, str]], load: dict[str, Any]) -> Simulation:
    with tempfile.TemporaryDirectory() as folder:
        table = {
            "name": "ring", "mesh": quarter(cells, thickness, kind, Path(folder)), "elements": kind, "density": 7800,
            "effects": {"corotational": {"young": YOUNG, "poisson": POISSON}, "fixed": fixed, "traction": load},
        }  # fmt: skip
        return static_scene(table)


def slopes(sim: Simulation, u: Reals, point: tuple[float, ...], radius: float) -> Reals:
    """du/dX (3, d) at a point with Y = 0, of the polynomials in its d coordinates nearest to u within a radius.

    Mirror images at Y = 0, a plane of symmetry, take part
    """
    d, mirror = len(point), np.array([1.0, -1.0, 1.0])
    at = sim.world.rest[:, :d] - np.array(point)
    at, moved = np.concatenate([at, at * mirror[:d]]), np.concatenate([u, u * mirror])
    near = np.linalg.norm(at, axis=1) < radius
    x = at[near] / radius
    powers = [c for n in range(DEGREE + 1) for c in combinations_with_replacement(range(d), n)]
    basis = np.column_stack([np.prod(x[:, list(c)], axis=1) for c in powers])
    return np.asarray(np.linalg.lstsq(basis, moved[near], rcond=None)[0][1 : 1 + d].T / radius)


# --- LE1: the membrane, in plane stress -------------------------------------------------------------------------------

THIN, PULL, LE1 = 0.1, 10e6, 92.7e6  # m, Pa, Pa


def membrane(cells: Cells, kind: str) -> float:
    """Stress along y [Pa] at the end of the inner ellipse on the x axis, under a pull on the outer one."""
    fixed = [*SIDES, {"where": "Z < 1e-6", "along": "z"}]
    sim = ring(cells, THIN, kind, fixed, {"where": ON_OUTER, "pressure": -SMALL * PULL})
    e = slopes(sim, settle(sim), (INNER[0], 0.0), 0.5)
    return float(YOUNG / (1 - POISSON**2) * (e[1, 1] + POISSON * e[0, 0]) / SMALL)


# --- LE10: the plate --------------------------------------------------------------------------------------------------

THICK, PRESSURE, LE10 = 0.6, 1e6, -5.38e6  # m, Pa, Pa


def plate(cells: Cells, kind: str) -> float:
    """The same stress at the upper side, under a pressure there; the outer side is held, its middle also along z."""
    middle = f"{ON_OUTER} and abs(Z - {THICK / 2}) < 1e-6"
    fixed = [*SIDES, {"where": ON_OUTER, "along": ["x", "y"]}, {"where": middle, "along": "z"}]
    sim = ring(cells, THICK, kind, fixed, {"where": f"Z > {THICK - 1e-6}", "pressure": SMALL * PRESSURE})
    e = slopes(sim, settle(sim), (INNER[0], 0.0, THICK), 0.6)
    whole = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    return float((whole * np.trace(e) + YOUNG / (1 + POISSON) * e[1, 1]) / SMALL)


# cells of the membrane and of the plate, and how much is allowed of each
COARSE = {"all": ((8, 16, 1), 0.15, (6, 10, 4), 0.4)}
FINE = {"all": ((16, 32, 2), 0.1, (12, 20, 6), 0.12), "quadratic": ((12, 24, 1), 0.1, (8, 14, 4), 0.12)}


def stresses(quick: bool) -> list[Row]:
    """Empty where `fixed` has no `along`, or where there is no `traction`."""
    rows, sizes = [], COARSE if quick else FINE
    for kind in kinds():
        thin, most, thick, more = sizes.get(kind, sizes["all"])
        for case, cells, run, known, allowed in (
            ("LE1, elliptic membrane: stress at D", thin, membrane, LE1, most),
            ("LE10, thick plate: stress at D", thick, plate, LE10, more),
        ):
            try:
                found = run(cells, kind)
            except UNKNOWN:
                return []
            what = f"NAFEMS {case} [MPa], {'x'.join(map(str, cells))} cells, {kind} elements"
            rows.append(relative(what, known / 1e6, found / 1e6, allowed, SOURCE))
    return rows


if __name__ == "__main__":
    for row in stresses(False):
        print(f"{row.ours:.6g} of {row.reference:.6g} | {row.case}", flush=True)
