# SPDX-License-Identifier: MIT
"""Hundreds of bodies in the same launches: each converges by itself, whoever solves it."""

import numpy as np
import pytest

from protocol.messages_pb2 import SolveStatus
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver

pytestmark = pytest.mark.gpu

HEAD = """dt = 0.02
[effects]
gravity = { g = [0, -9.81, 0] }
[solver]
preconditioner = "cholesky"
update = "every-4"
"""
OBJECT = """
[[object]]
name = "body{k}"
mesh = {{ bar = {bar}, size = [1, 1, {length}] }}
pose = {{ translate = [{x}, 0, 0], rotate = [0, {angle}, 0] }}
density = 1000
[object.effects]
corotational = {{ young = {young}, poisson = 0.4 }}
rayleigh = {{ mass = 0.1, stiffness = 0.01 }}
fixed = {{ where = "Z < 0.01" }}
"""


def scene(path, bars):
    objects = [
        OBJECT.format(k=k, bar=list(bar), length=bar[2] / 2, x=3 * k, angle=7 * k, young=1e5 * (1 + k % 5))
        for k, bar in enumerate(bars)
    ]
    path.write_text(HEAD + "".join(objects))
    return path


@pytest.mark.parametrize(
    "bars",
    [
        [(2, 2, 4)] * 5 + [(4, 4, 10)],  # each with thread blocks of its own
        [(1, 1, 3)] * 150 + [(2, 2, 4)] * 20,  # a pool
        [(1, 1, 2)] * 300 + [(5, 5, 20)],  # a pool beside a body with thread blocks of its own
    ],
    ids=["own", "pool", "both"],
)
def test_as_on_the_cpu(bars, tmp_path):
    path = scene(tmp_path / "many.toml", bars)
    runs = []
    for device in ("gpu", "cpu"):
        sim = Simulation.load(path, [], device)
        runs.append((Driver(sim).advance(9), sim.fetch().x.copy()))
    (g, x_gpu), (c, x_cpu) = runs
    assert g["body"].tolist() == c["body"].tolist() and g["step"].tolist() == c["step"].tolist()
    assert (g["status"] == SolveStatus.CONVERGED).all() and g["residual"].max() <= 1e-6
    assert (g["iterations"] <= c["iterations"] + 2).all(), "each as many as alone"
    assert len(set(g["iterations"].tolist())) > 1
    assert np.abs(x_gpu - x_cpu).max() < 1e-5


def test_the_same_bits_whoever_solves_them(tmp_path):
    path = scene(tmp_path / "many.toml", [(1, 1, 3)] * 280)
    ends = []
    for _ in range(2):
        sim = Simulation.load(path, [], "gpu")
        Driver(sim).advance(6)
        ends.append(sim.fetch().x.copy())
    assert np.array_equal(*ends)


def test_each_as_one_alone(tmp_path):
    """Bodies with a multiprocessor for each, whose matrix passes through it: equal ones to the bit, as on the CPU."""
    count, bar = 200, (5, 5, 20)
    text = OBJECT.format(k="{k}", bar=list(bar), length=bar[2] / 2, x="{x}", angle=0, young=1e5)
    ends = []
    for device, bodies in (("gpu", count), ("cpu", 1)):
        path = tmp_path / f"{device}.toml"
        path.write_text(HEAD + "".join(text.replace("{k}", str(k)).replace("{x}", "0") for k in range(bodies)))
        sim = Simulation.load(path, [], device)
        assert (Driver(sim).advance(6)["status"] == SolveStatus.CONVERGED).all()
        ends.append(sim.fetch().x.reshape(bodies, -1, 3).copy())
    gpu, cpu = ends
    assert (gpu == gpu[0]).all()
    assert np.abs(gpu[0] - cpu[0]).max() < 1e-5
