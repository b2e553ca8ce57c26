# SPDX-License-Identifier: MIT
"""The tangent of corotational tetrahedra that knows how their rotations change, kept positive semi-definite."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.simulation import Simulation
from tests.physics.test_forces import REGIONS, SIZE, elastic_forces, stir, stirred
from tests.physics.test_system_matrix import LARGE, error, frame, tangent
from tests.reference.corotational import deformation, exact_tangent
from tests.scenes import bar, elastic, interior, jittered_bar, mesh_file, random_rotations, simulation, solid
from tests.texts import module_in


def exact_bar(folder: Path, tangent: str = "exact", **table) -> Simulation:
    """A bar of unequal elements and two materials."""
    solver = {k: table.pop(k) for k in ("dt", "warp", "gravity") if k in table}
    mesh = mesh_file(folder, *jittered_bar((3, 2, 2), SIZE, seed=2))
    return simulation(bar(mesh=mesh, young=REGIONS, poisson=0.2, tangent=tangent, **table), **solver)


def clamped(sim: Simulation) -> int:
    """Elements in which an eigenvalue of a twist is negative."""
    body, count = solid(sim), 0
    for tet, poisson in zip(body.tets, body.poisson, strict=True):
        s = np.linalg.svd(deformation(body.x[tet], body.rest[tet]), compute_uv=False)
        s[2] *= np.sign(np.linalg.det(deformation(body.x[tet], body.rest[tet])))
        ratio = 2 * poisson / (1 - 2 * poisson)  # lambda / mu
        count += 1 + (ratio * (s.sum() - 3) - 2) / (s[1] + s[2]) < 0
    return count


@stirred
@pytest.mark.parametrize("fixed", [None, "X < 0.01"])
def test_matrix_and_right_side_are_the_reference(tmp_path, size, fixed):
    """The reference uses singular vectors and a 9x9 matrix, the kernel neither; also where elements are inverted."""
    sim = exact_bar(tmp_path, damping=(0.7, 0.03), dt=0.013, fixed=fixed, gravity=(1, -9.81, 2))
    stir(sim, size)
    sim.engine.assemble()
    reference = solid(sim)
    assert 0 < clamped(sim) < len(elastic(sim).elements)
    A, R, b = reference.matrix(), frame(sim), reference.right_side()
    found = sim.matrix().toarray()
    assert np.abs(found - R.T @ A @ R).max() < 1e-10 * np.abs(A).max()
    assert np.abs(found - found.T).max() < 1e-15 * np.abs(found).max()
    assert np.linalg.eigvalsh(found)[0] > 0.999 * min(1.0, sim.world.mass[sim.world.free > 0].min())
    assert np.abs(sim.system.b * sim.world.free[:, None] - b).max() < 1e-10 * np.abs(b).max()


@pytest.mark.parametrize("stretch", [1.02, 1.3, 2.0])
def test_it_is_the_slope_of_the_forces_where_nothing_is_clamped(tmp_path, stretch):
    sim = exact_bar(tmp_path)
    for R in random_rotations(2, seed=9):
        sim.world.x[:] = stretch * sim.world.rest @ R.T
        stir(sim, 0.02 * (stretch - 1))
        assert clamped(sim) == 0
        assert error(sim) < 1e-7


@pytest.mark.parametrize("case", ["sheared by 0.3", "stretched by 1.2"])
def test_it_is_nearer_to_the_slope_than_the_usual_one(tmp_path, case):
    F, moved, _, _ = LARGE[case]
    errors = []
    for kind in ("usual", "exact"):
        sim = exact_bar(tmp_path, kind)
        sim.world.x[:] = sim.world.rest @ F.T
        stir(sim, moved)
        errors.append(error(sim))
    assert errors[1] < 0.6 * errors[0]


def test_where_all_is_clamped_it_is_the_usual_one(tmp_path):
    matrices = []
    for kind in ("usual", "exact"):
        sim = exact_bar(tmp_path, kind)
        sim.world.x[:] = 0.8 * sim.world.rest
        sim.engine.assemble()
        matrices.append(sim.matrix().toarray())
    assert np.abs(matrices[0] - matrices[1]).max() < 1e-14 * np.abs(matrices[0]).max()


def test_the_projection_removes_the_negative_eigenvalues_of_an_element_and_no_others():
    """Clamping the twists is the projection of d2W/dF2 onto the positive semi-definite matrices."""
    random = np.random.default_rng(1)
    X = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    to_F = np.linalg.inv(np.column_stack([np.ones(4), X]))[1:].T
    dF = np.einsum("aj,ik->ijak", to_F, np.eye(3)).reshape(9, 12)
    pseudo = np.linalg.pinv(dF)
    for _ in range(50):
        x = X + 0.4 * random.normal(size=(4, 3))
        H, clamped_H = (6 * pseudo.T @ exact_tangent(x, X, 1e3, 0.3, c) @ pseudo for c in (False, True))
        values, vectors = np.linalg.eigh(H)
        expected = vectors @ np.diag(np.maximum(values, 0)) @ vectors.T
        assert np.abs(clamped_H - expected).max() < 1e-9 * np.abs(H).max()


def newton(sim: Simulation, free: NDArray[np.bool_], iterations: int) -> NDArray:
    """Norms of the forces on the free degrees of freedom, over the first, by the kernels' forces and tangents."""
    found = []
    for _ in range(iterations):
        forces = elastic_forces(sim).ravel()[free].copy()
        found.append(np.linalg.norm(forces))
        step = np.zeros(free.size)
        step[free] = np.linalg.solve(tangent(sim)[np.ix_(free, free)], forces)
        sim.world.x += step.reshape(-1, 3)
    return np.array(found) / found[0]


@pytest.mark.parametrize(("kind", "least", "most"), [("usual", 1e-2, 1.0), ("exact", 0.0, 1e-11)])
def test_newton_is_quadratic_with_it_under_tension(tmp_path, kind, least, most):
    """Six faces held stretched, the inside started anywhere: with the exact tangent four iterations reach rounding
    (1, 2e-2, 1e-5, 5e-12), with the usual one fourteen leave 2 %."""
    size = (1.2, 1.0, 0.8)
    table = bar(mesh=mesh_file(tmp_path, *jittered_bar((4, 4, 4), size, seed=1)), young=1e5, tangent=kind)
    sim = simulation(table, warp=False)
    rest = sim.world.rest
    sim.world.x[:] = rest * [1.5, 1.3, 1.4] + 0.1 * np.sin(4 * rest[:, [1, 2, 0]])
    found = newton(sim, np.repeat(interior(rest, size), 3), 14)
    assert least <= found[13] and found[3 if kind == "exact" else 13] < most


def test_newton_is_faster_with_it_where_some_is_clamped(tmp_path):
    """A bar pulled and twisted: linear, by 12 a step in place of 3."""
    rates = []
    for kind in ("usual", "exact"):
        sim = exact_bar(tmp_path, kind, warp=False)
        rest = sim.world.rest
        c, s = np.cos(0.5 * rest[:, 0]), np.sin(0.5 * rest[:, 0])
        y, z = rest[:, 1] - 0.5, rest[:, 2] - 0.4
        sim.world.x[:] = np.stack([1.3 * rest[:, 0], c * y - s * z, s * y + c * z], axis=1)
        found = newton(sim, np.repeat((rest[:, 0] > 1e-9) & (rest[:, 0] < SIZE[0] - 1e-9), 3), 10)
        assert clamped(sim) > 0
        rates.append(found[9] / found[8])
    assert rates[1] < 0.15 < 0.25 < rates[0]


def test_single_precision_agrees(tmp_path):
    sim = exact_bar(tmp_path)
    stir(sim, 0.1)
    e, w, found = elastic(sim), sim.world, []
    for real, dtype in (("float", np.float32), ("double", np.float64)):
        m = len(e.elements)
        x, v, gradients, lame = (a.astype(dtype) for a in (w.x, w.v, e.gradients, e.lame))
        out: dict[str, NDArray] = {"quaternion": np.zeros((m, 4), dtype)}
        out |= {
            "scaled_gradients": np.zeros((m, 4, 4), dtype),
            "twist": np.zeros((m, 6), dtype),
            "nodal_impulse": np.zeros((m, 4, 3), dtype),
        }
        module_in("effects/corotational_exact.cu", real).bind(
            "elements", m, tets=e.elements, x=x, v=v, gradients=gradients, lame=lame,
            stiffness_coefficient=np.full(m, w.dt**2, dtype), h=w.dt, **out,
        )()  # fmt: skip
        found.append(out)
    for name in ("twist", "nodal_impulse", "scaled_gradients"):
        single, double = (out[name].astype(float) for out in found)
        assert np.abs(single - double).max() < 2e-5 * np.abs(double).max(), name


FLAT = {
    "a point": lambda x: 0 * x,
    "a line": lambda x: x * [1.0, 0.0, 0.0],
    "a plane": lambda x: x * [1.0, 1.0, 0.0],
    "inside out": lambda x: x * [-1.0, 1.0, 1.0],
    "a long needle": lambda x: x * [1e3, 0.0, 0.0],
}


@pytest.mark.parametrize("shape", FLAT.values(), ids=FLAT.keys())
def test_the_matrix_is_definite_in_any_shape(tmp_path, shape):
    sim = exact_bar(tmp_path)
    sim.world.x[:] = shape(sim.world.rest)
    sim.engine.assemble()
    A = sim.matrix().toarray()
    assert np.isfinite(A).all()
    assert np.linalg.eigvalsh(A)[0] > -1e-12 * np.abs(A).max()


def test_the_default_is_the_usual_one(tmp_path):
    """A scene compiles and launches no kernel of another variant."""
    sim = simulation(bar())
    assert [launch.name for launch in sim.engine.launches[1:4]] == [
        "corotational.elements", "corotational_nodes.gather", "corotational_blocks.blocks",
    ]  # fmt: skip
    assert elastic(sim).twist.size == 0
    names = {launch.name for launch in exact_bar(tmp_path).engine.launches}
    assert {"corotational_exact.elements", "corotational_exact_nodes.gather"} <= names
