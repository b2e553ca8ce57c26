# SPDX-License-Identifier: MIT
"""`bench verification`: published beams and a membrane under loads, by kind of elements.

Alone: `python -m tests.bench.verification.bending`.
"""

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.mesh import bar as bar_mesh
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.verification.loads import push, raised, settle
from tests.bench.verification.locking import UNKNOWN, Reals, body, kinds, nodes_of
from tests.bench.verification.row import Row, relative
from tests.bench.verification.static import elastica
from tests.reference.quadratic_statics import face_shares

Mesh = tuple[Reals, NDArray[Any]]  # nodes (n, 3) [m], linear tetrahedra (m, 4)
MOST = {"linear": 0.95, "patch": 0.95, "smoothed": 0.6, "quadratic": 0.1}  # too little or too much on coarse meshes


def face_forces(mesh: Mesh, kind: str, on: Callable[[Reals], NDArray[np.bool_]], force: list[float]) -> list[Any]:
    """A force [N] spread evenly over a face, as `push` takes it: nodes that bear as much are one group."""
    ten = nodes_of(*mesh, kind)
    share = face_shares(ten.rest, ten.tets, on(ten.rest))
    share /= share.sum()
    groups = []
    for part in np.unique(share[share > 0].round(12)):
        nodes = np.flatnonzero(np.isclose(share, part, rtol=1e-9, atol=1e-13))
        groups.append((nodes, [f * part * len(nodes) for f in force]))
    return groups


def moved(sim: Simulation, on: Callable[[Reals], NDArray[np.bool_]], u: Reals) -> Reals:
    """Mean displacement [m] of the nodes of a face, (3,)."""
    return np.asarray(u[on(sim.world.rest)].mean(axis=0))


# --- MacNeal and Harder's straight cantilever -----------------------------------------------------------------------

THIN, SMALL = (6.0, 0.2, 0.1), 1e-4  # m; part of the unit load
MACNEAL = {"in its plane": (1, 0.1081), "out of its plane": (2, 0.4321)}
MACNEAL_SOURCE = "MacNeal and Harder 1985: 6 x 0.2 x 0.1, E 1e7, ν 0.3, a unit load at the tip"


def thin_beam(cells: tuple[int, int, int], kind: str, axis: int) -> float:
    """Deflection of the tip under a unit shear load along an axis."""
    box = bar_mesh(cells, THIN)
    mesh, law = (box.rest, box.tets), {"young": 1e7, "poisson": 0.3}

    def tip(rest: Reals) -> NDArray[np.bool_]:
        return np.asarray(rest[:, 0] > THIN[0] - 1e-6)

    sim = body(*mesh, kind, law, {"where": "X < 1e-6"})
    push(sim, face_forces(mesh, kind, tip, [SMALL * (k == axis) for k in range(3)]))
    return float(moved(sim, tip, settle(sim))[axis] / SMALL)


def macneal(quick: bool) -> list[Row]:
    rows = []
    for cells in ((30, 2, 2),) if quick else ((30, 2, 2), (60, 4, 4)):
        for kind in kinds():
            for name, (axis, known) in MACNEAL.items():
                case = f"MacNeal-Harder beam, {name}, {'x'.join(map(str, cells))} cells, {kind} elements (locking)"
                rows.append(relative(case, known, thin_beam(cells, kind, axis), MOST[kind], MACNEAL_SOURCE))
    return rows


# --- the beam of SOFA's validation scenes ---------------------------------------------------------------------------

ROD, ROD_YOUNG, ROD_POISSON, ROD_DENSITY, G = (0.02, 0.02, 0.2), 2e6, 0.45, 1100.0, 9.81
ROD_SOURCE = "elastica under its weight, and shear by Timoshenko; the beam of SOFA's examples/Validation"


def rod_reference() -> float:
    """Deflection [m] of the tip under the beam's weight: bending without extension, and shear."""
    width, _, length = ROD
    weight = ROD_DENSITY * G * width**2  # N/m
    bent = elastica(weight * length**3 / (ROD_YOUNG * width**4 / 12), True)[0] * length
    shear = ROD_YOUNG / (2 * (1 + ROD_POISSON))
    part = 10 * (1 + ROD_POISSON) / (12 + 11 * ROD_POISSON)  # Cowper 1966, a rectangle
    return bent + weight * length**2 / (2 * part * shear * width**2)


def rod(cells: tuple[int, int, int], split: str, kind: str) -> float:
    """Deflection [m] of its tip."""
    box = bar_mesh(cells, ROD, split)
    law = {"young": ROD_YOUNG, "poisson": ROD_POISSON, "tangent": "exact"}
    sim = body(box.rest, box.tets, kind, law, {"where": "Z < 1e-6"}, (0.0, -G, 0.0), ROD_DENSITY)
    return float(-moved(sim, lambda rest: rest[:, 2] > ROD[2] - 1e-7, settle(sim))[1])


def sofa_rod(quick: bool) -> list[Row]:
    known, rows = rod_reference(), []
    for cells in ((2, 2, 14),) if quick else ((4, 4, 29), (8, 8, 58)):
        for split in ("kuhn", "mirrored"):
            for kind in kinds() if cells[0] < 8 else sorted({*kinds()} - {"quadratic"}):
                case = f"SOFA's beam [m], {'x'.join(map(str, cells))} cells, {split}, {kind} elements (locking)"
                rows.append(relative(case, known, rod(cells, split, kind), MOST[kind], ROD_SOURCE))
    return rows


# --- an end moment --------------------------------------------------------------------------------------------------

ROLLED, TURN, PARTS = (10.0, 1.0, 1.0), np.pi / 3, 12  # m; angle of the end
ROLLED_SOURCE = "Euler: M = EI θ / L bends a beam to an arc of a circle; here to a sixth of one, ν = 0"


def rolled(cells: tuple[int, int, int], kind: str) -> float:
    """Height of the tip over the beam's length where a moment at its end, which turns with it, bends it to an arc."""
    box, young = bar_mesh(cells, ROLLED), 1e6
    sim = body(box.rest, box.tets, kind, {"young": young, "poisson": 0.0, "tangent": "exact"}, {"where": "X < 1e-6"})
    mesh = nodes_of(box.rest, box.tets, kind)
    end = mesh.rest[:, 0] > ROLLED[0] - 1e-6
    share, height = face_shares(mesh.rest, mesh.tets, end), mesh.rest[:, 1] - 0.5
    loaded = np.flatnonzero(end & (share > 0) & (abs(height) > 1e-9))
    inertia = float(share[loaded] @ height[loaded] ** 2)
    driver, u, before = Driver(sim), np.zeros_like(mesh.rest), np.zeros_like(mesh.rest)
    for part in [*range(1, PARTS + 1), *[PARTS] * 3]:  # with the last turn once more, until the forces have it, too
        stretch = u[end] + mesh.rest[end]
        slope = np.linalg.lstsq(np.column_stack([height[end], np.ones(end.sum())]), stretch, rcond=None)[0][0]
        along = np.array([slope[1], -slope[0], 0.0]) / np.hypot(slope[0], slope[1])  # of the beam's axis at its end
        moment = young / 12 * TURN / ROLLED[0] * part / PARTS
        pull = -moment * share[loaded] * height[loaded] / inertia
        push(sim, [(np.array([i]), list(f * along)) for i, f in zip(loaded, pull, strict=True)])
        driver.advance(2)  # close to equilibrium before they begin, steps end at rounding and not at their tolerance
        before, u = u, np.asarray(sim.world.x - sim.world.rest)
    if abs(u - before).max() > 1e-4 * ROLLED[0]:
        raise ArithmeticError("no equilibrium was found")
    return float(u[end, 1].mean() / ROLLED[0])


def circle(quick: bool) -> list[Row]:
    known, rows = (1 - np.cos(TURN)) / TURN, []
    for cells in ((20, 2, 1),) if quick else ((20, 2, 1), (40, 4, 2)):
        for kind in kinds() if cells[1] < 4 else sorted({*kinds()} - {"quadratic"}):
            case = f"end moment, height of the tip over the length, {cells[1]} cells over the height, {kind} elements"
            rows.append(relative(f"{case} (locking)", known, rolled(cells, kind), MOST[kind], ROLLED_SOURCE))
    return rows


# --- Cook's membrane in plane strain --------------------------------------------------------------------------------

COOK = 18.50
COOK_SOURCE = "quadratic tetrahedra, 48 x 48, 18.49 to 18.52, apart (tests/reference/quadratic_statics.py)"


def plane_strain(cells: int, split: str, kind: str) -> float:
    """Deflection of (48, 52) for E = 1, ν = 0.4999 and a shear force of 1 per thickness: no node moves across."""
    box = bar_mesh((cells, cells, 1), (1.0, 1.0, 1.0), split)
    thickness, (X, Y, Z) = 48 / cells, box.rest.T
    mesh = np.column_stack([48 * X, 44 * X + Y * (44 - 28 * X), thickness * Z]), box.tets
    fixed = [{"where": "X < 1e-6"}, {"where": "X >= 0", "along": "z"}]
    sim = body(*mesh, kind, {"young": 1.0, "poisson": 0.4999}, fixed)

    def right(rest: Reals) -> NDArray[np.bool_]:
        return np.asarray(rest[:, 0] > 48 - 1e-6)

    u = raised(sim, face_forces(mesh, kind, right, [0.0, 1e-6 * thickness, 0.0]), 1)
    at = right(sim.world.rest) & (abs(sim.world.rest[:, 1] - 52) < 1e-6)
    return float(u[at, 1].mean() / 1e-6)


def cook_plane_strain(quick: bool) -> list[Row]:
    """Empty where `fixed` has no `along`."""
    rows = []
    for cells, split in product((8,) if quick else (8, 16, 32), ("kuhn", "mirrored")):
        for kind in kinds():
            try:
                found = plane_strain(cells, split, kind)
            except UNKNOWN:
                return []
            what = f"ν = 0.4999, {cells} x {cells} cells, {split}, {kind} elements (locking)"
            rows.append(relative(f"Cook's membrane, plane strain, {what}", COOK, found, MOST[kind], COOK_SOURCE))
    return rows


CASES = [macneal, sofa_rod, circle, cook_plane_strain]

if __name__ == "__main__":
    for run in CASES:
        for row in run(False):
            print(f"{row.ours:.6g} of {row.reference:.6g} | {row.case}", flush=True)
