# SPDX-License-Identifier: MIT
"""The account of energy on a GPU run by threads of the processor: sums over the nodes of bodies, and freezing."""

import ctypes as c
import subprocess
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sim_server.backends.compiler import INCLUDE, SOURCES, compiler
from sim_server.backends.cpu.structs import BALANCE
from sim_server.backends.gpu.energies import ENERGY_BALANCE, SUMS, node_chunks, start_balances
from sim_server.backends.gpu.structs import ENERGY_RECORD

G = np.array([0.3, -9.81, 2.0])
STILL = ("v", "dv", "predictor", "damping_velocity", "inertial_increment")
MOTION = ("x", "before", *STILL)
TEXT = """
#include "cuda_threads.h"
#include "energy_balance.cu"
extern "C" void settle(int chunks, int threads, const EnergyBalance* a) {
    launch(chunks, threads, [&] { energy_balance(*a); });
}
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    folder = tmp_path_factory.mktemp("account")
    (folder / "settle.cpp").write_text(TEXT)
    paths = [f"-I{p}" for p in (folder, Path(__file__).parent, SOURCES / "backends/gpu", INCLUDE)]
    command = [compiler(), "-std=c++17", "-O1", "-shared", "-fPIC", "-pthread", "-Dreal=double", *paths]
    subprocess.run([*command, str(folder / "settle.cpp"), "-o", str(folder / "settle.so")], check=True)
    return c.CDLL(str(folder / "settle.so"))


class Bodies:
    """Random ones of so many nodes each, after a step from `before` to x; `chunk` nodes make a thread block."""

    def __init__(self, sizes: list[int], threads: int, on_runaway: int = 0, chunk: int = 40):
        rng, self.n, self.threads = np.random.default_rng(len(sizes)), sum(sizes), threads
        self.first_node = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
        shape = (self.n, 3)
        self.motion = {name: rng.normal(size=shape) for name in MOTION}
        self.motion["before"] = self.motion["x"] - 0.1 * rng.normal(size=shape)
        self.mass, self.free = rng.uniform(1, 2, self.n), np.ones(self.n)
        touched = rng.random(self.n) < 0.3
        self.force = rng.normal(size=shape) * touched[:, None]
        self.spring, self.anchor = rng.uniform(0, 5, self.n) * touched, rng.normal(size=shape)
        self.balance = np.zeros(len(sizes), BALANCE)
        self.balance["start"], self.balance["limit"] = 1e6, 1e6
        self.records = np.zeros((4, len(sizes)), ENERGY_RECORD)
        self.step, self.settled_step = np.ones(1, "i8"), np.zeros(len(sizes), "i8")
        self.chunks = node_chunks(self.first_node, chunk)
        self.sums, self.finished_chunks = np.full((len(self.chunks), SUMS), np.nan), np.zeros(len(sizes), "u4")
        self.gravity, self.params = G, np.zeros((), ENERGY_BALANCE)
        names = (
            "mass",
            "force",
            "spring",
            "anchor",
            "free",
            "balance",
            "records",
            "step",
            "settled_step",
            "first_node",
            "gravity",
        )
        for name in (*names, "chunks", "sums", "finished_chunks"):
            self.params[name] = getattr(self, name).ctypes.data
        for name in ("x", "v", "before"):
            self.params[name] = self.motion[name].ctypes.data
        self.params["still"] = [self.motion[name].ctypes.data for name in STILL]
        self.params["bodies"], self.params["capacity"], self.params["inertia"] = len(sizes), 4, 1
        self.params["on_runaway"] = on_runaway

    def settle(self, library: c.CDLL) -> None:
        library.settle(len(self.chunks), self.threads, c.c_void_p(self.params.ctypes.data))

    def expected(self, body: int) -> dict[str, float]:
        nodes = slice(self.first_node[body], self.first_node[body + 1])
        x, v, before = (self.motion[name][nodes] for name in ("x", "v", "before"))
        step, k = x - before, self.spring[nodes, None]
        work = ((self.force[nodes] + k * (self.anchor[nodes] - 0.5 * (x + before))) * step).sum()
        gravity = -float(self.mass[nodes] @ (x @ G))
        kinetic = 0.5 * float(self.mass[nodes] @ (v**2).sum(axis=1))
        fallen = float(self.mass[nodes] @ (step @ G))
        found = {"kinetic": kinetic, "gravity": gravity, "work": float(work), "budget": 1e6 + float(work) + fallen}
        return found | {"stride": float(np.ptp(step, axis=0).max())}


@pytest.mark.parametrize(
    ("sizes", "threads"),
    [([1], 32), ([7, 60, 1, 1, 33, 64, 2], 32), ([40, 25], 64), ([300], 128), ([90, 130, 70], 128), ([1999], 32)],
)
def test_each_body_gets_the_sums_over_its_own_nodes(library, sizes, threads):
    bodies = Bodies(sizes, threads)
    expected = [bodies.expected(k) for k in range(len(sizes))]
    state = {name: array.copy() for name, array in bodies.motion.items()}
    bodies.settle(library)
    for k, found in enumerate(bodies.records[0]):
        for name, value in expected[k].items():
            assert found[name] == pytest.approx(value, rel=1e-6 if name == "stride" else 1e-11), (k, name)
        assert np.isnan(found["elastic"]) and found["phase"] == found["found"] == 0
    assert not bodies.force.any() and not bodies.spring.any()  # until something touches them again
    assert all(np.array_equal(array, bodies.motion[name]) for name, array in state.items()) and bodies.free.all()
    assert (bodies.settled_step == 1).all() and not bodies.finished_chunks.any()
    once = bodies.records[0].tobytes()
    bodies.motion["v"][:] = 7
    bodies.settle(library)  # a second time: of a step that is settled
    assert bodies.records[0].tobytes() == once
    again = Bodies(sizes, threads)
    again.settle(library)
    assert again.records[0].tobytes() == once  # to the bit


@pytest.mark.parametrize("on_runaway", [0, 1, 2])
def test_what_has_too_much_goes_back_and_rests_and_nothing_else(library, on_runaway):
    sizes, threads = [40, 50, 3, 33], 64
    bodies = Bodies(sizes, threads, on_runaway)
    fast, long, wrong, well = (slice(a, b) for a, b in zip(bodies.first_node, bodies.first_node[1:], strict=False))
    bodies.motion["v"][fast] *= 1e4
    bodies.balance["limit"][1] = 1e-3
    bodies.motion["v"][wrong] = np.nan
    state = {name: array.copy() for name, array in bodies.motion.items()}
    bodies.settle(library)
    assert bodies.records[0]["found"].tolist() == ([1, 1, 1, 0] if on_runaway < 2 else [0] * 4)
    assert bodies.records[0]["phase"].tolist() == {0: [2, 2, 2, 0], 1: [1, 1, 1, 0], 2: [0] * 4}[on_runaway]
    for nodes in (fast, long, wrong):
        same = [np.array_equal(state[n][nodes], bodies.motion[n][nodes], equal_nan=True) for n in MOTION]
        assert all(same) == (on_runaway > 0)
        if on_runaway == 0:
            assert np.array_equal(bodies.motion["x"][nodes], state["before"][nodes]) and not bodies.free[nodes].any()
            assert not any(bodies.motion[n][nodes].any() for n in MOTION if n not in ("x", "before"))
    assert all(np.array_equal(state[n][well], bodies.motion[n][well]) for n in MOTION) and bodies.free[well].all()
    bodies.step[0] = 2
    bodies.settle(library)
    if on_runaway == 0:
        assert bodies.records[1]["phase"].tolist() == [2, 2, 2, 0] and not bodies.records[1]["found"].any()
        assert not bodies.records[1]["kinetic"][:3].any()


@pytest.mark.parametrize("real", [np.float64, np.float32])
def test_a_balance_begins_with_the_sums_of_its_own_body(real):
    rng, sizes, dt = np.random.default_rng(3), [1, 5, 40, 2, 17], 0.01
    starts = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int32)
    mass, shape = rng.uniform(1, 2, starts[-1]), (starts[-1], 3)
    x, v = rng.normal(size=shape).astype(real), rng.normal(size=shape).astype(real)
    balance = np.zeros(len(sizes), BALANCE)
    balance["elastic"], balance["diagonal"], balance["mass"] = 7, 0.5, 3
    untouched = balance.copy()
    given = SimpleNamespace(starts=starts, mass=mass, gravity=G, inertia=True)
    begun = np.array([0, 2, 3, 4])
    start_balances(balance, begun, given, x, v, dt)
    assert balance[1] == untouched[1]
    for b in begun:
        own = slice(starts[b], starts[b + 1])
        at, speed = x[own].astype(float), v[own].astype(float)
        kinetic, size = 0.5 * mass[own] @ (speed**2).sum(axis=1), max(0.5, np.linalg.norm(np.ptp(at, axis=0)))
        expected = {
            "kinetic": kinetic, "gravity": -mass[own] @ (at @ G), "start": kinetic + 7, "budget": kinetic + 7,
            "floor": 1.5 * (1e-3 * size / dt) ** 2, "limit": 4 * size + 2 * dt * np.ptp(speed, axis=0).max(),
        }  # fmt: skip
        for name, value in expected.items():
            assert balance[b][name] == pytest.approx(value, rel=1e-12, abs=1e-12), (b, name)
