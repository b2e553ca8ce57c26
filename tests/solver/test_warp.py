# SPDX-License-Identifier: MIT
"""The warp: a factor made in one configuration serves in another as Q P^-1 Q^T with Q = R_s R_t^T.

The loop never forms Q: it solves in the material frame, A' = R^T A R, where the factor of A'(t) *is* the warped one.
Here Q is written out and compared (Courtecuisse et al. 2010, eq. 12 and 13; the printed order of eq. 13, R_t^T R_s,
agrees only while the rotations commute).
"""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag, cho_factor, cho_solve

from sim_server.backends.kinds import Kind
from sim_server.simulation import Simulation
from tests.reference.pcg import pcg
from tests.scenes import bar, factor_of, rotation, simulation
from tests.solver.solves import solve, stops, system

AXES = {"x": (1, 0, 0), "y": (0, 1, 0), "z": (0, 0, 1), "any": (1, -2, 0.5), "other": (-0.3, 0.4, 2)}
FREE = {"young": 1e7, "poisson": 0.4}
ONCE = {"tolerance": 1e-6, "warm_start": False, "max_iterations": 2000, "factor_precision": "float64"}


def free_body(warp: bool = True) -> Simulation:
    """A bar that nothing holds, with velocities that deform it; the first half of its first step is made."""
    sim = simulation(bar((5, 2, 2), (2.5, 1, 1), **FREE), preconditioner="cholesky", warp=warp, **ONCE)
    sim.world.v[:] = np.random.default_rng(0).normal(size=sim.world.v.shape)
    sim.engine.assemble()
    return sim


def turn(sim: Simulation, R: NDArray) -> None:
    """The body as a whole, positions and velocities; then the first half of a step."""
    sim.world.x[:] = sim.world.x @ R.T + [1.0, 2.0, 3.0]
    sim.world.v[:] = sim.world.v @ R.T
    sim.engine.assemble()


@pytest.mark.parametrize("angle", [1, 20, 45, 90, 135, 180, 270])
@pytest.mark.parametrize("axis", AXES.values(), ids=AXES.keys())
def test_a_turned_body_needs_one_iteration_with_the_factor_of_the_unturned_one(axis, angle):
    iterations = {}
    for warp in (True, False):
        sim = free_body(warp)
        sim.engine.post_factor(0, *factor_of(sim), step=0)
        assert solve(sim)[1]["iterations"] == 1
        turn(sim, rotation(axis, np.radians(angle)))
        _, record = solve(sim)
        assert record["status"] == 0
        assert record["kind"] == Kind.CHOLESKY
        iterations[warp] = int(record["iterations"])
    assert iterations[True] == 1
    assert iterations[False] >= (2 if angle == 1 else 4)


def test_frames_stay_the_identity_without_the_warp_and_where_nothing_tells_rotations():
    """Bit by bit; the nodes of the bodies do not fill whole vector registers."""
    posed = {"fixed": "X < 0.01", "pose": {"rotate": [40, 0, 70]}}
    objects = [
        bar((3, 2, 2), name="a", **posed),
        bar((1, 1, 1), name="dust", young=None),
        bar((5, 2, 1), name="c", **posed),
    ]
    for warp, followed in ((True, {0, 2}), (False, set())):
        sim = simulation(*objects, gravity=(3.0, -9.81, 2.0), warp=warp)
        sim.engine.run(3)
        identity = [np.array_equal(R, np.tile(np.eye(3), (len(R), 1, 1))) for R in frames_of(sim)]
        assert identity == [body not in followed for body in range(3)]
        assert sim.warped == followed


def frames_of(sim: Simulation) -> list[NDArray]:
    """Rotations of the nodes of each body, (n, 3, 3)."""
    return [sim.system.rotation[body.nodes] for body in sim.world.bodies]


def test_the_matrix_of_a_turned_body_is_the_same_in_the_material_frame():
    sim = free_body()
    A, b = system(sim)
    turn(sim, rotation((1, 2, 3), 2.0))
    turned, b_turned = system(sim)
    assert abs(turned - A).max() < 1e-12 * abs(A).max()
    assert np.abs(b_turned - b).max() < 1e-10 * np.abs(b).max()


def bent(seed: int, bend: float, twist: float) -> Simulation:
    """The same bar held at one end, bent about z and twisted about x (rotations that do not commute), posed as well."""
    sim = simulation(
        bar((6, 2, 2), (3, 1, 1), young=1e7, poisson=0.4, fixed="X < 0.01", pose={"rotate": [40, 0, 70]}),
        preconditioner="cholesky", **ONCE,
    )  # fmt: skip
    X = sim.world.rest - [0, 0.5, 0.5]
    shape = np.array(
        [rotation((0, 0, 1), bend * x[0]) @ rotation((1, 0, 0), twist * x[0]) @ [0, x[1], x[2]] for x in X]
    )
    angle = bend * X[:, 0]
    radius = 1 / bend if bend else 0.0
    arc = [radius * np.sin(angle), radius * (1 - np.cos(angle)), 0 * angle] if bend else [X[:, 0], 0 * angle, 0 * angle]
    pose = rotation((0, 0, 1), np.radians(70)) @ rotation((1, 0, 0), np.radians(40))
    sim.world.x[:] = (shape + np.stack(arc, axis=1) + [0, 0.5, 0.5]) @ pose.T
    sim.world.v[:] = np.random.default_rng(seed).normal(size=X.shape) * sim.world.free[:, None]
    sim.engine.assemble()
    return sim


@pytest.fixture(scope="module")
def states() -> tuple[Simulation, Simulation]:
    """The configuration t in which the factor is made, and s in which it is used."""
    return bent(1, bend=0.1, twist=0.3), bent(2, bend=0.5, twist=-0.5)


def world_frame(sim: Simulation) -> tuple[NDArray, NDArray, NDArray]:
    """A, b and the nodes' rotations R (block diagonal) in the world frame."""
    R = block_diag(*sim.system.rotation)
    A, b = system(sim)
    return R @ A.toarray() @ R.T, R @ b, R


def test_the_loop_makes_the_iterates_of_the_explicit_warp(states):
    """After k iterations in the material frame, R y_k is x_k of conjugate gradients on A x = b with Q P^-1 Q^T."""
    at_t, at_s = states
    A_t, _, R_t = world_frame(at_t)
    A_s, b_s, R_s = world_frame(at_s)
    P, Q = cho_factor(A_t), R_s @ R_t.T
    expected = pcg(A_s, b_s, lambda r: Q @ cho_solve(P, Q.T @ r), 1e-6, 500)
    at_s.engine.post_factor(0, *factor_of(at_t), step=0)
    ends = list(stops(A_s, b_s, expected[:13]))
    assert len(ends) > 6
    for k, tolerance in ends:
        y, record = solve(at_s, kind=Kind.CHOLESKY, tolerance=tolerance)
        assert (record["iterations"], record["status"], record["fallbacks"]) == (k, 0, 0)
        bound = 1e-9 if k <= 8 else 1e-6  # the iteration amplifies rounding
        assert np.linalg.norm(R_s @ y - expected[k]) < bound * np.linalg.norm(expected[-1])
    y, record = solve(at_s, kind=Kind.CHOLESKY, tolerance=1e-6)
    assert abs(int(record["iterations"]) - (len(expected) - 1)) <= 1
    assert np.linalg.norm(R_s @ y - expected[-1]) < 1e-4 * np.linalg.norm(expected[-1])


def test_the_printed_order_is_worse_where_rotations_do_not_commute(states):
    at_t, at_s = states
    A_t, _, R_t = world_frame(at_t)
    A_s, b_s, R_s = world_frame(at_s)
    P = cho_factor(A_t)

    def iterations(Q: NDArray) -> int:
        return len(pcg(A_s, b_s, lambda r: Q @ cho_solve(P, Q.T @ r), 1e-6, 2000)) - 1

    right, printed, none = iterations(R_s @ R_t.T), iterations(R_t.T @ R_s), iterations(np.eye(len(A_t)))
    assert right < 0.7 * printed
    assert right < 0.5 * none


def test_the_orders_agree_while_rotations_commute():
    """A bend in a plane of a body that is not posed: what the paper's figures show."""
    configurations = [np.array([rotation((0, 0, 1), bend * x) for x in np.linspace(0, 3, 7)]) for bend in (0.1, 0.5)]
    R_t, R_s = configurations
    right, printed = R_s @ np.swapaxes(R_t, 1, 2), np.swapaxes(R_t, 1, 2) @ R_s
    assert np.abs(right - printed).max() < 1e-15


def test_rotations_are_from_rest_and_hold_the_pose():
    """The rest shape stays unposed, so that two equal bodies posed apart have the same matrix, and factors fit both."""
    posed = simulation(bar(fixed="X < 0.01", pose={"rotate": [40, 0, 70], "translate": [1, 2, 3]}))
    plain = simulation(bar(fixed="X < 0.01"))
    posed.engine.assemble()
    plain.engine.assemble()
    expected = rotation((0, 0, 1), np.radians(70)) @ rotation((1, 0, 0), np.radians(40))
    assert np.abs(posed.system.rotation - expected).max() < 1e-13
    assert np.array_equal(posed.world.rest, plain.world.rest)
    assert abs(posed.matrix() - plain.matrix()).max() < 1e-12 * abs(plain.matrix()).max()
