# SPDX-License-Identifier: MIT
"""Attachments and springs on a GPU beside the CPU's. Runs where there is a GPU: pytest -m gpu."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar
from tests.state import put
from tests.system.server_process import Stage
from tests.system.test_replay_of_a_server import replayed
from tests.ties.test_attachments_and_springs import FLOOR, glue, half, made, masses

pytestmark = pytest.mark.gpu

GRAFT = "deploy/scenes/graft.toml"
EXACT = {"tolerance": 1e-11, "preconditioner": "block_jacobi", "max_iterations": 3000}


def compare(sims: list[Simulation], steps: int, within: float = 1e-8) -> tuple[np.ndarray, np.ndarray]:
    """Runs steps of a GPU and a CPU side by side; returns records and reactions of the GPU."""
    found = []
    for _ in range(steps):
        for sim in sims:
            sim.engine.run(1)
        sims[0].fetch()
        assert np.abs(sims[0].world.x - sims[1].world.x).max() < within
        (records, reactions), (expected, forces) = (sim.engine.records_and_reactions() for sim in sims)
        assert (records["status"] == expected["status"]).all()
        np.testing.assert_allclose(reactions, forces, atol=1e-5 * max(np.abs(forces).max(), 1e-9))
        assert (sims[0].ties.broken == sims[1].ties.broken).all()
        found.append((records, reactions))
    np.testing.assert_allclose(
        found[-1][0]["work"], expected["work"], rtol=1e-4, atol=1e-6 * np.abs(expected["work"]).max()
    )
    return tuple(np.array(each) for each in zip(*found, strict=True))  # type: ignore[return-value]


def both(**keys: Any) -> list[Simulation]:
    objects = keys.pop("objects")
    return [made(*objects, device=device, **keys) for device in ("gpu", "cpu")]


def test_the_graft_tears_as_on_a_cpu() -> None:
    """A holder, an attachment to a body, a spring, without contact."""
    sims = [
        Simulation.load(GRAFT, [f"solver.{key}={value}" for key, value in EXACT.items()], device)
        for device in ("gpu", "cpu")
    ]
    compare(sims, 90)
    assert 0 < (sims[0].ties.broken > 0).sum() < len(sims[0].ties.broken)


def test_two_glued_bars_are_one() -> None:
    keys = {"young": 1e6, "damping": (10.0, 0.01)}
    one = made(bar((8, 2, 2), (2, 0.5, 0.5), fixed="X < 0.01", **keys), device="gpu")
    two = made(half("a", 0, "X < 0.01", **keys), half("b", 1, **keys), attachment=[glue()], device="gpu")
    for sim in (one, two):
        sim.engine.run(450)
        sim.fetch()
    assert two.world.x[:, 1].min() == pytest.approx(one.world.x[:, 1].min(), abs=1e-7)
    force, weight = two.engine.records_and_reactions()[1][-2:, 0, :3], 9.81 * two.world.mass.sum() / 2
    np.testing.assert_allclose(force, [[0, weight, 0], [0, -weight, 0]], atol=1e-3 * weight)


def test_attachments_and_a_spring_break_in_the_same_step() -> None:
    torn = both(objects=[half("a", 0, "X < 0.01"), half("b", 1)], attachment=[glue(breaking=400.0)])
    compare(torn, 60, 1e-7)
    assert (torn[0].ties.broken > 0).sum() >= 2
    slack = [masses(rest_length=0.5, breaking=300.0, device=device) for device in ("gpu", "cpu")]
    for sim in slack:
        v = np.zeros(sim.world.v.shape)
        v[sim.world.bodies[1].nodes] = [0.5, 0, 0]
        put(sim, sim.world.v, v)
    compare(slack, 40)
    assert slack[0].ties.broken[0] > 0


def test_a_tool_that_holds_one_of_two_glued_bars_over_a_floor() -> None:
    """With contact: nodes on a moving obstacle, on another body and in contact; a factor knows them, too."""
    keys = [{"time": 0, "translate": [0, 2, 0]}, {"time": 0.5, "translate": [0.2, 2.3, 0], "rotate": [0, 0, 30]}]
    tool = {"name": "tool", "shape": "sphere", "radius": 0.1, "keyframes": keys}
    floor = FLOOR | {"pose": {"translate": [0, -0.01, 0]}}
    stuck = {"name": "stuck", "object": "a", "where": "X < 0.01", "to": "tool"}
    effect = {"thickness": 0.01, "tolerance": 1e-8, "passes": 200}
    given = {"objects": [half("a", 0), half("b", 1)], "obstacle": [floor, tool], "attachment": [stuck, glue()]}
    records, _ = compare(both(contact=effect, **given), 30)
    assert records["contacts"].max() > 0


def test_a_needle_holder_pulls_at_tissue_that_is_sutured_to_a_plate() -> None:
    """With contact: held nodes, attached ones and ones that touch, of one body; the suture tears."""
    table = tomllib.loads(Path("deploy/scenes/needle_holder.toml").read_text()) | {"name": "suture", "solver": EXACT}
    table["effects"] |= {"contact": {"thickness": 2e-4, "tolerance": 1e-8, "passes": 100}}
    plate = {"name": "plate", "shape": "box", "size": [0.03, 0.004, 0.06], "pose": {"translate": [0.03, -0.0021, 0.02]}}
    nodes = "abs(X - 0.03) < 0.001 and Y < 0.001 and abs(Z - 0.02) < 0.011"
    suture = {"name": "suture", "object": "tissue", "where": nodes, "to": "plate", "breaking": 0.02}
    table |= {"obstacle": [plate], "attachment": [suture]}
    scene = Scene.model_validate(table, context={"folder": "."})
    sims = [Simulation(scene, device) for device in ("gpu", "cpu")]
    records, _ = compare(sims, 70)
    assert records["contacts"].max() > 0 and sims[0].ties.broken.any()


def test_a_factor_that_knows_attachments_needs_few_iterations() -> None:
    """Of one body that an obstacle holds; two bodies choose between their factors and block Jacobi."""
    keys = {"young": 1e6}
    solver = {"preconditioner": "cholesky", "tolerance": 1e-8, "update": "lockstep-3"}
    to_floor = glue(name="foot", object="a", to="floor", where="X < 0.01")
    for objects, attached, part in (
        ([half("a", 0, **keys)], [to_floor], 0.5),
        ([half("a", 0, **keys), half("b", 1, **keys)], [to_floor, glue()], 1.05),
    ):
        sim = made(*objects, obstacle=[FLOOR], attachment=attached, solver=solver, device="gpu")
        driver = Driver(sim)
        driver.step_with_fresh_factors()
        records = np.concatenate([driver.advance(1) for _ in range(20)])
        jacobi = made(*objects, obstacle=[FLOOR], attachment=attached, solver={"tolerance": 1e-8}, device="gpu")
        jacobi.engine.run(21)
        theirs = jacobi.engine.records()[len(objects) :]  # of the same steps: the first one had a fresh factor
        assert records["factor_step"][-1] > 0 and np.array_equal(records["step"], theirs["step"])
        assert records["iterations"].sum() < part * theirs["iterations"].sum()


def test_a_replay_of_a_graft_is_the_same_bit_for_bit(tmp_path: Path) -> None:
    stage, log = Stage(tmp_path), tmp_path / "run.mcap"
    try:
        options = ("--device", "gpu", "--free-run", "--steps", "120", "--set", "solver.update=lockstep-3")
        server = stage.server(GRAFT, "--record", str(log), *options)
        assert server.wait() == 0, server.output()
    finally:
        stage.close()
    assert replayed(log, 0)["same"]
