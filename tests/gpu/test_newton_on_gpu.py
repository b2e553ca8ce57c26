# SPDX-License-Identifier: MIT
"""Several linearizations a step: the GPU beside the CPU, decision by decision. Runs where there is a GPU.

The linear systems are solved so tightly that both sides take the same decisions: as many linearizations, the same
status, in every step of every body. A failure prints the steps side by side, the first one that differs marked.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.messages_pb2 import SolveStatus
from sim_server.backends.gpu.cuda import CudaDevice
from sim_server.backends.gpu.step_graphs import FEW
from sim_server.errors import InputError
from sim_server.scene import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, scene
from tests.state import put

pytestmark = pytest.mark.gpu

GRAVITY = (0.0, -9.81, 0.0)
TIGHT = {"tolerance": 1e-10, "preconditioner": "block_jacobi", "max_iterations": 4000}
SOFT = {"young": 3e4, "poisson": 0.35}
SAME = ("step", "body", "linearizations", "status", "kind", "bad_node", "factor_step")
Prepare = Callable[[Simulation], None]


def of_law(law: str, **table: Any) -> dict:
    """A bar of a hyperelastic law."""
    constants = table.pop("constants", SOFT)
    made = bar(young=None, **{"cells": (4, 2, 2), "size": (2, 0.8, 0.8), "fixed": "X < 0.01"} | table)
    made["effects"][law] = dict(constants)
    return made


def thrown(velocity: tuple[float, float, float], body: int = 0) -> Prepare:
    """The free nodes of a body begin with a velocity [m/s]."""

    def prepare(sim: Simulation) -> None:
        v, nodes = sim.world.v.copy(), sim.world.bodies[body].nodes
        v[nodes] = sim.world.free[nodes, None] * np.array(velocity)
        put(sim, sim.world.v, v)

    return prepare


@dataclass
class Run:
    """x, v (steps, n, 3) after each step; its records."""

    x: NDArray
    v: NDArray
    records: NDArray[Any]
    sim: Simulation


def run(
    device: str, made: Scene, steps: int, prepare: Prepare | None = None,
    between: Callable[[Simulation, int], None] | None = None,
) -> Run:  # fmt: skip
    sim = Simulation(made, device)
    if prepare:
        prepare(sim)
    x, v = [], []
    for step in range(steps):
        if between:
            between(sim, step)
        sim.engine.run(1)
        sim.fetch()
        x.append(sim.world.x.copy())
        v.append(sim.world.v.copy())
    return Run(np.array(x), np.array(v), sim.engine.records(), sim)


def table(cpu: Run, gpu: Run, wrong: NDArray[np.bool_]) -> str:
    """Both runs side by side, up to a little after the first record that is wrong."""
    names = ("linearizations", "status", "iterations", "nonlinear", "residual", "bad_node", "factor_step")
    lines = [
        f"{'':2}{'step':>5}{'body':>5}" + "".join(f"{name + ' (cpu, gpu)':>34}" for name in names) + "   largest dx"
    ]
    first = int(np.argmax(wrong)) if wrong.any() else len(wrong)
    for k, (c, g) in enumerate(zip(cpu.records, gpu.records, strict=True)):
        if k > first + 6:
            break
        nodes = cpu.sim.world.bodies[c["body"]].nodes
        far = np.abs(cpu.x[c["step"] - 1, nodes] - gpu.x[c["step"] - 1, nodes]).max()
        line = f"{'* ' if wrong[k] else '  '}{c['step']:5}{c['body']:5}"
        lines.append(line + "".join(f"{c[n]:>20.6g}, {g[n]:>12.6g}" for n in names) + f"   {far:.3g}")
    return "\n".join(lines)


def compare(cpu: Run, gpu: Run, near: float = 1e-7) -> None:
    """The same decisions in each step of each body, and the same motion to `near` of the size of all [m]."""
    assert len(cpu.records) == len(gpu.records), (len(cpu.records), len(gpu.records))
    wrong = np.zeros(len(cpu.records), bool)
    for name in SAME:
        wrong |= cpu.records[name] != gpu.records[name]
    size = np.ptp(cpu.sim.world.rest, axis=0).max()
    for k, record in enumerate(cpu.records):
        nodes, step = cpu.sim.world.bodies[record["body"]].nodes, record["step"] - 1
        c, g = cpu.x[step, nodes], gpu.x[step, nodes]
        wrong[k] |= not np.array_equal(np.isfinite(c), np.isfinite(g))
        wrong[k] |= bool(np.nanmax(np.abs(c - g), initial=0) > near * size)
        left = np.array(
            [record["nonlinear"], gpu.records[k]["nonlinear"]]
        )  # converged: below the tolerance, or rounding
        told = record["status"] == SolveStatus.MAX_LINEARIZATIONS
        wrong[k] |= bool(told and left.max() > 1e-6 and np.ptp(left) > 0.05 * left.max())
    text = f"{wrong.sum()} of {len(wrong)} records differ (positions: by {near * size:.3g} m or more)"
    assert not wrong.any(), f"{text}:\n{table(cpu, gpu, wrong)}"
    speed = max(1.0, float(np.nanmax(np.abs(cpu.v), initial=0)))
    assert np.nanmax(np.abs(cpu.v - gpu.v), initial=0) < 1e-5 * speed


def both(
    make: Callable[[], Scene], steps: int, prepare: Prepare | None = None, between: Any = None, near: float = 1e-7
) -> tuple[Run, Run]:  # fmt: skip
    cpu, gpu = (run(device, make(), steps, prepare, between) for device in ("cpu", "gpu"))
    compare(cpu, gpu, near)
    return cpu, gpu


# --- one body -------------------------------------------------------------------------------------------------------

SEARCH = {"linearizations": 12, "trials": 4, "tolerance": 1e-7}
MODELS = {
    "st_venant_kirchhoff": lambda: of_law("st_venant_kirchhoff"),
    "stable_neo_hookean": lambda: of_law("stable_neo_hookean"),
    "corotational": lambda: bar((4, 2, 2), (2, 0.8, 0.8), young=3e4, fixed="X < 0.01", damping=(0.2, 0.01)),
    "exact": lambda: bar((4, 2, 2), (2, 0.8, 0.8), young=3e4, fixed="X < 0.01", rotation="polar", tangent="exact"),
}


@pytest.mark.parametrize("model", MODELS)
def test_each_model_takes_the_decisions_of_the_cpu(model):
    cpu, gpu = both(lambda: scene(MODELS[model](), dt=0.05, gravity=GRAVITY, integrator=SEARCH, **TIGHT), 6)
    assert (cpu.records["linearizations"] > 1).all() and np.abs(cpu.x[-1] - cpu.x[0]).max() > 0.05
    once = run("gpu", scene(MODELS[model](), dt=0.05, gravity=GRAVITY, **TIGHT), 6)
    assert np.abs(once.x - gpu.x).max() > 1e-4, "one linearization is something else"


@pytest.mark.parametrize("scheme", ["newmark", "bdf2", "generalized_alpha"])
def test_schemes_that_look_back(scheme):
    made = lambda: scene(  # noqa: E731
        of_law("stable_neo_hookean", damping=(0.1, 0.01)), dt=0.05, gravity=GRAVITY,
        integrator=SEARCH | {"scheme": scheme}, **TIGHT,
    )  # fmt: skip
    cpu, _ = both(made, 6, thrown((0.5, -1.0, 0.3)))
    assert cpu.records["linearizations"].max() > 2


@pytest.mark.parametrize("law", ["st_venant_kirchhoff", "stable_neo_hookean"])
def test_quasi_static(law):
    made = lambda: scene(  # noqa: E731
        of_law(law, constants={"young": 2e5, "poisson": 0.3}), dt=1.0, gravity=GRAVITY,
        integrator={"scheme": "quasi_static", "linearizations": 20, "trials": 3, "tolerance": 1e-6}, **TIGHT,
    )  # fmt: skip
    cpu, _ = both(made, 1)  # a second one would begin with rounding
    assert (cpu.records["status"] == SolveStatus.CONVERGED).all() and cpu.records["linearizations"][0] > 2


@pytest.mark.parametrize("law", ["st_venant_kirchhoff", "stable_neo_hookean"])
def test_shorter_ways_are_tried_as_on_the_cpu(law):
    """A soft beam falls into its equilibrium at once, along tangents that lead too far."""

    def made(trials: int) -> Scene:
        search = {"scheme": "quasi_static", "linearizations": 25, "trials": trials, "tolerance": 1e-6}
        held = of_law(law, constants={"young": 3e4, "poisson": 0.4})
        return scene(held, dt=0.2, gravity=GRAVITY, integrator=search, projection="none", **TIGHT)

    whole = run("cpu", made(0), 1)
    cpu, _ = both(lambda: made(5), 1, near=1e-6)
    assert whole.records["linearizations"][0] != cpu.records["linearizations"][0], "the line search has no part in it"
    assert cpu.records["status"][0] == SolveStatus.CONVERGED


def test_linearizations_that_do_not_suffice_are_told():
    search = {"linearizations": 2, "trials": 1, "tolerance": 1e-12}
    made = lambda: scene(MODELS["corotational"](), dt=0.05, gravity=GRAVITY, integrator=search, **TIGHT)  # noqa: E731
    _, gpu = both(made, 4)
    assert (gpu.records["status"] == SolveStatus.MAX_LINEARIZATIONS).all()
    assert (gpu.records["linearizations"] == 2).all() and (gpu.records["nonlinear"] > 1e-12).all()


# --- what is not finite ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("trials", [0, 5])
def test_a_trial_that_is_no_state_is_made_shorter_or_given_up(trials):
    """neo_hookean refuses elements that are turned inside out: their forces are not finite."""
    search = {"linearizations": 12, "trials": trials, "tolerance": 1e-6}
    held = of_law("neo_hookean", constants={"young": 2e4, "poisson": 0.3})
    made = lambda: scene(held, dt=0.1, integrator=search, **TIGHT)  # noqa: E731
    cpu, _ = both(made, 3, thrown((-20.0, 6.0, 0.0)), near=1e-6)
    lost = cpu.records["status"] == SolveStatus.NOT_FINITE
    assert lost.any() if trials == 0 else not lost[0]


def test_a_bad_number_is_named_and_stays_in_its_body():
    others = [
        bar((2, 2, 2), (1, 1, 1), name=f"b{k}", young=5e4, fixed="X < 0.01", pose={"translate": [0, 3 * k, 0]})
        for k in (1, 2)
    ]
    make = lambda: scene(MODELS["corotational"](), *others, dt=0.03, gravity=GRAVITY, integrator=SEARCH, **TIGHT)  # noqa: E731

    def spoil(sim: Simulation, step: int) -> None:
        if step == 2:
            v = sim.fetch().v.copy()
            v[sim.world.bodies[1].first + 11, 1] = np.nan
            put(sim, sim.world.v, v)

    cpu, gpu = (run(device, make(), 4, None, spoil) for device in ("cpu", "gpu"))
    for k in (0, 2):
        nodes = cpu.sim.world.bodies[k].nodes
        assert np.abs(cpu.x[:, nodes] - gpu.x[:, nodes]).max() < 1e-7
        assert (gpu.records["status"][gpu.records["body"] == k] == 0).all()
    for name in ("linearizations", "status", "bad_node"):
        assert cpu.records[name].tolist() == gpu.records[name].tolist(), name
    assert gpu.records["status"][gpu.records["body"] == 1].tolist()[2] == SolveStatus.NOT_FINITE


# --- several bodies -------------------------------------------------------------------------------------------------


def crowd() -> Scene:
    """At rest, stiff, soft, tiny, of another law, of springs: each has its own way to converge."""
    at = [{"pose": {"translate": [0, 3 * k, 0]}} for k in range(6)]
    springs = bar((3, 2, 2), (1.5, 0.8, 0.8), young=None, name="springs", fixed="X < 0.01", **at[5])
    springs["effects"]["mass_spring"] = {"young": 5e4}
    return scene(
        bar((2, 1, 1), (1, 0.5, 0.5), name="idle", young=1e6, **at[0]),
        bar((5, 2, 2), (2, 0.8, 0.8), name="stiff", young=1e7, fixed="X < 0.01", **at[1]),
        bar((6, 2, 2), (3, 0.8, 0.8), name="soft", young=2e4, poisson=0.45, fixed="X < 0.01", **at[2]),
        bar((1, 1, 1), (0.3, 0.3, 0.3), name="tiny", young=1e5, fixed="X < 0.01", **at[3]),
        of_law("stable_neo_hookean", name="law", **at[4]), springs,
        dt=0.04, integrator={"linearizations": 12, "trials": 3, "tolerance": 1e-7}, **TIGHT,
    )  # fmt: skip


def stir(sim: Simulation) -> None:
    v = np.zeros_like(sim.world.v)
    for body, velocity in zip(sim.world.bodies, [0, 0.5, -6, 1, 3, -2], strict=True):
        v[body.nodes] = sim.world.free[body.nodes, None] * np.array([0.2 * velocity, velocity, 0.0])
    put(sim, sim.world.v, v)


def test_bodies_are_solved_each_by_itself():
    cpu, gpu = both(crowd, 6, stir)
    of = cpu.records["linearizations"].reshape(-1, 6)
    assert (of[:, 0] == 1).all() and max(len(set(row)) for row in of.tolist()) >= 3, of
    idle = gpu.sim.world.bodies[0].nodes
    assert np.array_equal(gpu.x[-1, idle], gpu.x[0, idle])


@pytest.mark.parametrize("bars", [[(1, 1, 2)] * 150, [(1, 1, 1)] * 140 + [(4, 3, 3)]], ids=["pool", "pool and one"])
def test_small_bodies_of_a_pool(bars):
    """More bodies than multiprocessors: whichever thread block is free takes the next that has a system to solve."""
    objects = [
        bar(cells, (0.5 * cells[0], 0.5, 0.5 * cells[2]), name=f"b{k}", young=1e4 * (1 + 9 * (k % 4)), fixed="X < 0.01",
            pose={"translate": [0, 2 * k, 0]})
        for k, cells in enumerate(bars)
    ]  # fmt: skip
    search = {"linearizations": 8, "trials": 1, "tolerance": 1e-7}
    cpu, _ = both(lambda: scene(*objects, dt=0.05, gravity=GRAVITY, integrator=search, **TIGHT), 3, near=1e-8)
    assert len(set(cpu.records["linearizations"].tolist())) > 1


# --- what goes on around it -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("trials", "loops"), [(0, False), (3, False), (3, True)])
def test_batches_of_steps_are_the_same_steps(monkeypatch, trials, loops):
    """Also those of a graph of many steps, where few trials fit without loops; the same bits, whoever adds them up."""
    monkeypatch.setattr(CudaDevice, "has_conditions", loops)
    search = {"linearizations": 6, "trials": trials, "tolerance": 1e-7}
    one, many, again = (
        Simulation(scene(MODELS["corotational"](), dt=0.04, gravity=GRAVITY, integrator=search, **TIGHT), "gpu")
        for _ in range(3)
    )
    batches = loops or 6 * (1 + trials) <= FEW
    assert [[bool(graph) for graph in row] for row in one.engine.loop.graphs] == [[True, batches, batches]] * 2
    for _ in range(20):
        one.engine.run(1)
    for sim in (many, again):
        sim.engine.run(20)
    records = [sim.engine.records() for sim in (one, many, again)]
    for other in records[1:]:
        for name in ("step", "iterations", "linearizations", "nonlinear", "residual", "status"):
            assert records[0][name].tolist() == other[name].tolist(), name
    for sim in (many, again):
        assert np.array_equal(one.fetch().x, sim.fetch().x) and np.array_equal(one.fetch().v, sim.fetch().v)
    assert (records[0]["linearizations"] > 1).all()


def test_a_push_moves_it_as_on_the_cpu():
    held = bar((4, 2, 2), (2, 0.8, 0.8), young=3e4, fixed="X < 0.01", touch={"max_force": 1000.0})
    make = lambda: scene(held, dt=0.03, gravity=GRAVITY, integrator=SEARCH, **TIGHT)  # noqa: E731

    def push(sim: Simulation, step: int) -> None:
        touch = sim.effects["touch"]
        if step == 2:
            touch.push("me", "bar", (2.0, 0.4, 0.4), 0.3, (0.0, 0.0, 90.0), 0.1)
        if step == 4:
            touch.grab("me", "bar", (2.0, 0.8, 0.8), 0.3, (2.0, 1.4, 1.0), 400.0, 50.0, 0.2)

    cpu, _ = both(make, 8, None, push)
    assert np.abs(cpu.x[3] - cpu.x[2])[:, 2].max() > 1e-3


def test_the_matrix_that_is_copied_is_that_of_the_first_linearization():
    make = lambda: scene(MODELS["exact"](), dt=0.05, gravity=GRAVITY, integrator=SEARCH, **TIGHT)  # noqa: E731
    found = []
    for device in ("cpu", "gpu"):
        sim = Simulation(make(), device)
        sim.engine.run(3)
        target = np.zeros_like(sim.system.values)
        sim.engine.request_matrix(0, target)
        sim.engine.run(2)
        assert sim.engine.matrix_step(0) == 3
        found.append(target)
        assert sim.engine.records()["linearizations"].min() > 1
    cpu, gpu = found
    assert np.abs(cpu - gpu).max() < 1e-6 * np.abs(cpu).max()


@pytest.mark.parametrize("update", ["never", "every-3", "lockstep-2"])
def test_factors_are_taken_up_at_the_same_steps(update):
    solver = {"tolerance": 1e-10, "preconditioner": "cholesky", "update": update, "warp": True}
    runs = []
    for device in ("cpu", "gpu"):
        sim = Simulation(scene(one(), two(), dt=0.04, gravity=GRAVITY, integrator=SEARCH, **solver), device)
        runs.append((Driver(sim).advance(8), sim.fetch().x.copy()))
    (c, x_cpu), (g, x_gpu) = runs
    for name in ("step", "body", "factor_step", "linearizations", "status", "kind"):
        assert c[name].tolist() == g[name].tolist(), f"{name}\n{c[name].tolist()}\n{g[name].tolist()}"
    assert (g["factor_step"][-4:] >= 0).all() and (g["fallbacks"] == 0).all() and (g["linearizations"] > 1).any()
    assert (g["iterations"] <= c["iterations"] + 3 * c["linearizations"]).all()
    assert np.abs(x_cpu - x_gpu).max() < 1e-6


def one() -> dict:
    return bar((5, 2, 2), (2, 0.8, 0.8), name="one", young=4e4, fixed="X < 0.01", damping=(0.1, 0.01))


def two() -> dict:
    return of_law("stable_neo_hookean", name="two", pose={"translate": [0, 3, 0]})


@pytest.mark.parametrize("precision", ["mixed", "float32"])
def test_rounding_of_single_precision_ends_the_search(precision):
    """In the motion of float64, and never at the end of what is allowed for want of digits."""
    loose = {"tolerance": 1e-4, "preconditioner": "block_jacobi", "max_iterations": 1000}
    search = {"linearizations": 12, "trials": 4, "tolerance": 1e-3}
    table_of = {"dt": 0.05, "gravity": GRAVITY, "integrator": search, **loose}
    reference, single = (
        run("gpu", scene(MODELS["stable_neo_hookean"](), precision=p, **table_of), 8) for p in ("float64", precision)
    )
    text = table(reference, single, np.zeros(8, bool))
    assert (single.records["status"] == SolveStatus.CONVERGED).all(), text
    assert (single.records["linearizations"] <= reference.records["linearizations"] + 1).all(), text
    assert np.abs(reference.x - single.x).max() < 1e-2 < 0.1 < np.abs(reference.x[-1] - reference.x[0]).max(), text


def test_a_step_with_one_linearization_has_nothing_of_it():
    engine = Simulation(scene(MODELS["corotational"](), gravity=GRAVITY, **TIGHT), "gpu").engine
    assert engine.sequence.newton is None and engine.solver.features.phases == () and not engine.loop.newton_results
    assert all(all(row) for row in engine.loop.graphs)


def test_more_trials_than_a_graph_holds_are_refused_without_loops(monkeypatch):
    made = scene(MODELS["corotational"](), integrator={"linearizations": 300, "trials": 8})
    Simulation(made, "gpu").engine.run(1)
    monkeypatch.setattr(CudaDevice, "has_conditions", False)
    with pytest.raises(InputError, match=r"linearizations = 300 with trials = 8: .* 2700, .*; allowed: .* up to 1024"):
        Simulation(made, "gpu")


# --- the loop of the graph ------------------------------------------------------------------------------------------

LOOPED: dict[str, tuple[Callable[[], Scene], Prepare | None, int]] = {
    "2 linearizations": (lambda: of_search(MODELS["stable_neo_hookean"](), linearizations=2), None, 12),
    "4 linearizations": (lambda: of_search(MODELS["corotational"](), linearizations=4, scheme="bdf2"), None, 12),
    "4, of which one is needed": (
        lambda: of_search(MODELS["corotational"](), linearizations=4, tolerance=0.5), thrown((0, -0.2, 0)), 12
    ),
    "shorter steps": (
        lambda: of_search(
            of_law("st_venant_kirchhoff", constants={"young": 3e4, "poisson": 0.4}), scheme="quasi_static",
            linearizations=25, trials=5, tolerance=1e-6,
        ), None, 2,
    ),
    "not finite": (
        lambda: of_search(of_law("neo_hookean", constants={"young": 2e4, "poisson": 0.3}), linearizations=4, trials=0),
        thrown((-20.0, 6.0, 0.0)), 3,
    ),
    "several bodies": (crowd, stir, 6),
}  # fmt: skip


def of_search(held: dict, **search: Any) -> Scene:
    return scene(held, dt=0.04, gravity=GRAVITY, integrator={"tolerance": 1e-7} | search, **TIGHT)


@pytest.mark.parametrize("case", LOOPED)
def test_a_loop_makes_the_steps_of_the_unrolled_form_to_the_bit(monkeypatch, case):
    make, prepare, steps = LOOPED[case]
    looped = run("gpu", make(), steps, prepare)
    monkeypatch.setattr(CudaDevice, "has_conditions", False)
    unrolled = run("gpu", make(), steps, prepare)
    assert looped.x.tobytes() == unrolled.x.tobytes() and looped.v.tobytes() == unrolled.v.tobytes()
    for name in ("iterations", "linearizations", "nonlinear", "residual", "status", "kind", "bad_node", "fallbacks"):
        assert looped.records[name].tobytes() == unrolled.records[name].tobytes(), name
    found = looped.records["linearizations"]
    assert (found == 1).all() if case == "4, of which one is needed" else found.max() > 1


def test_halves_of_a_step_are_the_step():
    """The second half has a loop, which only graphs have."""
    whole, halves = (Simulation(of_search(MODELS["exact"](), linearizations=4), "gpu") for _ in range(2))
    for _ in range(4):
        whole.engine.run(1)
        halves.engine.assemble()
        halves.engine.solve()
    assert np.array_equal(whole.fetch().x, halves.fetch().x)
    assert whole.engine.records()["linearizations"].tolist() == halves.engine.records()["linearizations"].tolist()
