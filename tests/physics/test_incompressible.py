# SPDX-License-Identifier: MIT
"""Elements of patches as Poisson's ratio nears 0.5: no pressure is unseen, displacements and pressures converge."""

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

from sim_server.mesh import Mesh, read
from sim_server.mesh import bar as bar_mesh
from sim_server.mesh.cell_builders import edge_cells, tetrahedron_cells
from sim_server.mesh.quadratic_cells import quadratic_cells
from sim_server.mesh.strain_cells import StrainCells
from sim_server.simulation import Simulation
from tests.reference.inf_sup import inf_sup, unseen
from tests.reference.quadratic_statics import PAIRS, POINTS
from tests.scenes import bar, jittered_bar, scene

BOXES = Path(__file__).resolve().parents[1] / "bench" / "verification" / "meshes"  # unstructured, made with Gmsh
POISSON = 0.4999
MU, BULK = 1 / (2 * (1 + POISSON)), 1 / (3 * (1 - 2 * POISSON))  # E = 1 Pa


def on_surface(rest: NDArray) -> NDArray:
    """Which components are normal to the faces of a box at its nodes, (n, 3)."""
    return np.asarray((np.abs(rest - rest.min(axis=0)) < 1e-6) | (np.abs(rest - rest.max(axis=0)) < 1e-6))


def cells_of(mesh: Mesh, kind: str) -> tuple[NDArray, StrainCells]:
    """Nodes and cells of a body of one material; of linear elements each is a patch."""
    if kind == "quadratic":
        ten = mesh.with_mid_nodes()
        assert ten.quadratic is not None
        return ten.rest, quadratic_cells(ten.rest, ten.quadratic)
    build = edge_cells if kind == "smoothed" else tetrahedron_cells
    cells = build(mesh.rest, mesh.tets, np.zeros(len(mesh.tets), np.int32))
    return mesh.rest, replace(cells, patch=cells.element) if kind == "linear" else cells


def constant(kind: str, tets: int) -> float:
    """Inf-sup constant of an unstructured box whose faces slide without friction."""
    rest, cells = cells_of(read(BOXES / f"box_{tets}.vtu"), kind)
    return inf_sup(cells, on_surface(rest))


@pytest.mark.parametrize(
    ("kind", "tets"),
    [("patch", (434, 1429, 5025)), ("smoothed", (434, 1429, 5025)), ("quadratic", (218, 434, 1429))],
)
def test_pressures_of_finer_meshes_are_seen_as_well(kind, tets):
    """Over these meshes without preferred directions the inf-sup constant falls by little, if at all; no proof."""
    found = [constant(kind, count) for count in tets]
    assert min(found) > 0.3 and found[-1] > 0.8 * found[1], found


def test_linear_elements_have_pressures_that_no_displacement_sees():
    """So the test above can fail: of patches there is one, the constant pressure in a box that keeps its volume."""
    mesh = read(BOXES / "box_434.vtu")
    found = {}
    for kind in ("linear", "patch", "smoothed", "quadratic"):
        rest, cells = cells_of(mesh, kind)
        found[kind] = unseen(cells, on_surface(rest))
    assert found["linear"] > 100
    assert found["patch"] == found["smoothed"] == found["quadratic"] == 1


# --- a made-up solution in the unit cube, whose faces slide without friction -----------------------------------------


def motion(X: NDArray) -> NDArray:
    """u (n, 3) without change of volume."""
    x, y, _ = np.pi * X.T
    return np.column_stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y), 0 * x])


def pressure(X: NDArray) -> NDArray:
    x, y, z = np.pi * X.T
    return np.asarray(np.cos(x) * np.cos(2 * y) * np.cos(z))


def body_force(X: NDArray) -> NDArray:
    """-div(2 mu e(u) - p I) (n, 3)."""
    x, y, z = np.pi * X.T
    a, b, c, d = np.cos(x), np.cos(2 * y), np.cos(z), np.sin(2 * y)
    slope = -np.pi * np.column_stack([np.sin(x) * b * c, 2 * a * d * c, a * b * np.sin(z)])
    return np.asarray(2 * np.pi**2 * MU * motion(X) + slope)


def nodal_forces(mesh: Mesh) -> NDArray:
    """Consistent ones (n, 3) of the body force."""
    nodes = mesh.tets if mesh.quadratic is None else mesh.quadratic
    corners = mesh.rest[nodes[:, :4]]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    out = np.zeros_like(mesh.rest)
    for p in POINTS:
        shape = p if mesh.quadratic is None else [*(p * (2 * p - 1)), *(4 * p[i] * p[j] for i, j in PAIRS)]
        force = volume[:, None] / 4 * body_force(np.einsum("a,mai->mi", p, corners))
        for a, N in enumerate(shape):
            np.add.at(out, nodes[:, a], N * force)
    return out


def stiffness(sim: Simulation) -> sp.csc_array:
    """Of the kernels at rest; held components have only their mass in it."""
    sim.engine.assemble()
    w = sim.world
    return sp.csc_array((sim.matrix() - sp.diags_array(np.repeat(w.mass, 3))) / (w.force_coefficient * w.dx_dv))


@dataclass(frozen=True)
class Errors:
    """Root mean squares over those of the solution."""

    displacement: float
    pressure: float


def errors(mesh: Mesh, kind: str) -> Errors:
    table = bar(poisson=POISSON, young=1.0, elements=kind, density=1.0)
    table["effects"]["fixed"] = [
        {"where": f"{axis} < 1e-6 or {axis} > 0.999999", "along": axis.lower()} for axis in "XYZ"
    ]
    made = scene(table, dt=100.0)
    made.objects[0].use_mesh(mesh.with_mid_nodes() if kind == "quadratic" else mesh)
    sim = Simulation(made)
    rest = sim.world.rest
    free = np.flatnonzero(~on_surface(rest).ravel())
    u = np.zeros(rest.size)
    u[free] = splu(stiffness(sim)[free][:, free].tocsc()).solve(nodal_forces(sim.world.bodies[0].mesh).ravel()[free])
    u = u.reshape(-1, 3)
    _, cells = cells_of(mesh, kind)
    owner = np.repeat(np.arange(len(cells.volume)), np.diff(cells.start))
    volume = np.bincount(cells.patch, cells.volume)
    change = np.bincount(cells.patch[owner], cells.volume[owner] * (cells.gradients * u[cells.nodes]).sum(axis=1))
    sums = [np.bincount(owner, rest[cells.nodes][:, k]) for k in range(3)]
    middle = np.stack(sums, axis=1) / np.bincount(owner)[:, None]
    exact = np.bincount(cells.patch, cells.volume * pressure(middle)) / volume
    found = -BULK * change / volume
    found, exact = (p - p @ volume / volume.sum() for p in (found, exact))
    return Errors(
        float(np.linalg.norm(u - motion(rest)) / np.linalg.norm(motion(rest))),
        float(np.sqrt(volume @ (found - exact) ** 2 / (volume @ exact**2))),
    )


def cube(cells: int) -> Mesh:
    return Mesh(*jittered_bar((cells,) * 3, (1, 1, 1), seed=1))


@pytest.mark.parametrize(("kind", "cells"), [("patch", (4, 6, 8)), ("smoothed", (4, 6, 8)), ("quadratic", (2, 4, 6))])
def test_displacements_and_pressures_converge(kind, cells):
    """Displacements with second order; no checkerboard of pressures stays."""
    found = [errors(cube(n), kind) for n in cells]
    for (n, coarse), (m, fine) in pairwise(zip(cells, found, strict=True)):
        assert np.log(coarse.displacement / fine.displacement) / np.log(m / n) > 1.6
    assert found[-1].displacement < 0.04
    assert found[-1].pressure < 0.75 * found[0].pressure


def test_linear_elements_lock_with_a_checkerboard_of_pressures():
    found = [errors(cube(n), "linear") for n in (4, 8)]
    assert found[1].displacement > 0.9 and found[1].pressure > found[0].pressure > 10


def test_quadratic_elements_of_regular_cells_move_right_whatever_their_pressures():
    """There the inf-sup constant falls with the size of the elements, so that pressures of single ones oscillate;
    displacements are of second order all the same."""
    boxes = [bar_mesh((n,) * 3, (1.0, 1.0, 1.0), "kuhn") for n in (2, 4)]
    coarse, fine = (errors(box, "quadratic") for box in boxes)
    assert fine.displacement < 0.25 * coarse.displacement and fine.displacement < 0.03
    assert fine.pressure > 0.5 * coarse.pressure
    seen = []
    for box in boxes:
        rest, cells = cells_of(box, "quadratic")
        seen.append(inf_sup(cells, on_surface(rest)))
    assert seen[1] < 0.7 * seen[0]
