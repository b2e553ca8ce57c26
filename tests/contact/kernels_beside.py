# SPDX-License-Identifier: MIT
"""Steps of contact by the kernels of a GPU, run by threads of the processor, beside those of the loop of the CPU."""

import ctypes as c
import re
import subprocess
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sim_server.backends.compiler import INCLUDE, SOURCES, compiler
from sim_server.backends.cpu.structs import BALANCE
from sim_server.backends.gpu import contact as gpu_contact
from sim_server.backends.gpu import faces as gpu_faces
from sim_server.backends.gpu import islands as gpu_islands
from sim_server.backends.gpu.contact import ContactPasses
from sim_server.backends.gpu.host_results import ContactResults
from sim_server.backends.gpu.solver import PCG_BODY
from sim_server.backends.gpu.structs import CONTACT_RESULT, CONTACT_STATE, PAIR_SUM, PCG_RESULT
from sim_server.backends.kinds import KINDS
from sim_server.simulation import Simulation

THREADS = 32  # of a thread block here
TESTS = Path(__file__).parent.parent
TEXT = """
#include "cuda_threads.h"
#include "invert3.cuh"
#include "contact.cu"
#ifdef FACE_ROWS
#include "faces.cu"
#endif
struct System { const int *row_start, *columns, *ranges; double tolerance; int most, bodies, grid; };
// Block Jacobi and conjugate gradients from y, as pcg.cu: to `goal` of the residual.
static void solve(const ContactArguments& c, const ContactSolve& pass, const System& s, int body) {
    ContactState& state = pass.state[body];
    if (pass.first_of_step ? state.phase == OVER : state.phase != READY) return;
    const int first = s.ranges[2 * body], n = s.ranges[2 * body + 1] - first;
    const double* b = c.contact_b + 3 * first;
    double* y = c.y + 3 * first;
    auto multiply = [&](const double* x, double* q) {
        for (int i = 0; i < n; ++i) {
            q[3 * i] = q[3 * i + 1] = q[3 * i + 2] = 0;
            for (int k = s.row_start[first + i]; k < s.row_start[first + i + 1]; ++k)
                for (int m = 0; m < 9; ++m)
                    q[3 * i + m / 3] += c.values[9 * k + m] * x[3 * (s.columns[k] - first) + m % 3];
        }
    };
    auto dot = [&](const std::vector<double>& u, const std::vector<double>& v) {
        double sum = 0;
        for (int k = 0; k < 3 * n; ++k) sum += u[k] * v[k];
        return sum;
    };
    std::vector<double> r(3 * n), q(3 * n), p(3 * n), z(3 * n), inverse(9 * n);
    multiply(y, q.data());
    double b2 = 0;
    for (int k = 0; k < 3 * n; ++k) { r[k] = b[k] - q[k]; b2 += b[k] * b[k]; }
    double r2 = dot(r, r);
    PcgResult& sum = c.results[c.step[0] % c.capacity * c.count + body];
    PcgResult out = {0, 0, -1, 0, CONVERGED, 2, 2, 0, -1, 0};
    int outcome = SOLVED;
    double goal = s.tolerance * s.tolerance * (state.phase == READY ? state.given2 : b2);
    if (state.phase == CHOOSE_START) {
        const bool zero = state.zero2 <= r2;
        for (int k = 0; k < 3 * n; ++k) {
            pass.last[3 * first + k] = -q[k];
            if (zero) y[k] = 0;
        }
        note_pass(state, pass, zero ? FROM_ZERO : FROM_START, sum, out);
        return;
    }
    if (state.phase == WITHOUT && !(r2 < b2)) {
        r2 = b2;
        for (int k = 0; k < 3 * n; ++k) { y[k] = 0; r[k] = b[k]; }
    }
    if (state.phase == READY) {
        outcome = outcome_of(state, pass, r2, goal);
        if (outcome == PASSED) goal = early_goal(state, pass, r2, goal);
        for (int k = 0; k < 3 * n; ++k) pass.first[3 * first + k] = pass.last[3 * first + k] = r[k];
        if (outcome == ENDED) {
            out.residual = state.given2 > 0 ? sqrt(r2 / state.given2) : 0;
            note_pass(state, pass, outcome, sum, out);
            return;
        }
    }
    for (int i = 0; i < n; ++i)
        for (int k = s.row_start[first + i]; k < s.row_start[first + i + 1]; ++k)
            if (s.columns[k] == first + i) invert3(c.values + 9 * k, true, inverse.data() + 9 * i);
    double rz = 0;
    for (; r2 > goal && out.iterations < s.most; ++out.iterations) {
        for (int k = 0; k < 3 * n; ++k) {
            const double *v = inverse.data() + 3 * k, *w = r.data() + k / 3 * 3;
            z[k] = v[0] * w[0] + v[1] * w[1] + v[2] * w[2];
        }
        const double zr = dot(z, r), beta = out.iterations ? zr / rz : 0;
        rz = zr;
        for (int k = 0; k < 3 * n; ++k) p[k] = z[k] + beta * p[k];
        multiply(p.data(), q.data());
        const double alpha = zr / dot(p, q);
        for (int k = 0; k < 3 * n; ++k) { y[k] += alpha * p[k]; r[k] -= alpha * q[k]; }
        r2 = dot(r, r);
    }
    out.residual = sqrt(r2 / (state.phase == READY ? state.given2 : b2));
    if (state.phase == READY) {
        multiply(y, q.data());
        for (int k = 0; k < 3 * n; ++k) pass.last[3 * first + k] = b[k] - q[k];
    }
    note_pass(state, pass, outcome, sum, out);
}
#ifdef FACE_ROWS
static void each_triangle(const ContactArguments& c, auto kernel) {
    const int count = c.faces.start[c.count] - c.faces.start[0];
    launch((count + CONTACT_THREADS - 1) / CONTACT_THREADS, CONTACT_THREADS, kernel);
}
#endif
static void one_pass(const ContactArguments& c, const ContactSolve& pass, const System& s) {
#ifdef FACE_ROWS
    launch(s.bodies, CONTACT_THREADS, [&] { face_forces(c); });
#endif
    launch(s.grid, CONTACT_THREADS, [&] { contact_forces(c); });
    for (int body = 0; body < s.bodies; ++body) solve(c, pass, s, body);
#ifdef FACE_ROWS
    launch(s.bodies, CONTACT_THREADS, [&] { face_search(c); });
    each_triangle(c, [&] { sweep_faces(c); });
#endif
    launch(s.grid, CONTACT_THREADS, [&] { contact_search(c); });
}
"""


class System(c.Structure):
    _fields_ = [
        ("row_start", c.c_void_p), ("columns", c.c_void_p), ("ranges", c.c_void_p), ("tolerance", c.c_double),
        ("most", c.c_int), ("bodies", c.c_int), ("grid", c.c_int),
    ]  # fmt: skip


SHORTER = {"device_contact.cuh": ["CONTACT_THREADS"], "island_state.cuh": ["LISTING_THREADS", "SEARCH_THREADS"]}


def compiled(folder: Path, text: str, *options: str) -> c.CDLL:
    """Compiles a text that includes kernels of contact, whose thread blocks have THREADS here."""
    for name, numbers in SHORTER.items():
        header = (SOURCES / "backends/gpu" / name).read_text()
        for number in numbers:
            header, found = re.subn(rf"{number} = \d+", f"{number} = {THREADS}", header)
            assert found == 1
        (folder / name).write_text(header)
    for name in ("contact.cu", "faces.cu", "face_sweep.cuh", "pairs.cu", "island.cu", "island_error.cuh", "ties.cu"):
        (folder / name).write_text((SOURCES / "backends/gpu" / name).read_text())
    (folder / "kernels.cpp").write_text(text)
    paths = [f"-I{p}" for p in (folder, TESTS / "backends", SOURCES / "backends/gpu", INCLUDE)]
    command = [compiler(), "-std=c++20", "-O1", "-shared", "-fPIC", "-Dreal=double", *options, *paths]
    subprocess.run([*command, str(folder / "kernels.cpp"), "-o", str(folder / "kernels.so")], check=True)
    return c.CDLL(str(folder / "kernels.so"))


# of rows, from step to step
REMEMBERED = ("obstacle", "corner", "weight", "normal", "force", "traction", "hardening", "gap", "entry")


class Array(np.ndarray):
    """Memory of the host in place of that of a device."""

    @property
    def data(self) -> Any:  # type: ignore[override]
        return SimpleNamespace(ptr=self.ctypes.data)

    def get(self) -> np.ndarray:
        return np.array(self)


def as_device(array: np.ndarray) -> Array:
    return np.array(array).view(Array)


class Host:
    """Stands for a GPU whose arrays are copies in memory of the host."""

    def __init__(self) -> None:
        self.types = {"real": "double", "local": "double"}
        self.twins: dict[int, tuple[np.ndarray, Array]] = {}
        kernels = SimpleNamespace(get_function=lambda name: None)
        self.cp = SimpleNamespace(
            asarray=as_device, zeros=lambda shape, dtype=float: as_device(np.zeros(shape, dtype)),
            RawModule=lambda **given: kernels,
        )  # fmt: skip

    def twin(self, host: np.ndarray, dtype: Any = None) -> Array:
        assert dtype in (None, host.dtype)
        return self.twins.setdefault(id(host), (host, as_device(host)))[1]

    def renew(self) -> None:
        for host, twin in self.twins.values():
            twin[...] = host


class Beside:
    """Steps of a simulation on a CPU, and the same solves by the kernels of a GPU."""

    def __init__(self, library: c.CDLL, sim: Simulation, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setattr(gpu_contact, "THREADS", THREADS)
        monkeypatch.setattr(gpu_faces, "THREADS", THREADS)
        for module in (gpu_contact, gpu_faces, gpu_islands):
            monkeypatch.setattr(module, "options", lambda types: ())
            monkeypatch.setattr(module, "compiled", lambda name, module, kernel: None)
        self.sim, self.library, self.gpu = sim, library, Host()
        given = sim.engine_input()
        assert given.contact is not None
        self.contact, bodies = given.contact, len(sim.world.bodies)
        self.results, self.told = as_device(np.zeros((4, bodies), PCG_RESULT)), np.zeros((4, bodies), CONTACT_RESULT)
        self.counter, self.rounds = as_device(np.zeros(1, np.int64)), 0
        self.work = np.zeros(bodies)
        self.reactions = np.zeros((4, bodies, len(self.contact.obstacles.kind), 6))
        self.balance = as_device(np.zeros(bodies, BALANCE))
        self.bodies = np.zeros(bodies, PCG_BODY)
        solver: Any = SimpleNamespace(
            errors=sim.scene.accuracy is not None, real=np.dtype(float),
            pool_counter=as_device(np.zeros(1, np.uint32)), results=self.results,
            counter=self.counter, bodies_device=self.bodies.ctypes.data,
        )  # fmt: skip
        self.broken = np.zeros(len(self.contact.ties.broken) if self.contact.ties else 0, np.int32)
        device: Any = SimpleNamespace(repeat=lambda flag: nullcontext(), branch=lambda flag: nullcontext())
        gpu: Any = self.gpu
        self.pairs = np.zeros((4, bodies, bodies), PAIR_SUM), np.zeros((4, bodies), np.int32)
        self.passes = ContactPasses(
            gpu, device, self.contact, given.ranges, given.arrays, solver, self.balance,
            ContactResults(self.told, self.reactions, self.broken, self.pairs),
        )  # fmt: skip
        self.arrays, self.ranges = given.arrays, np.array(given.ranges, np.int32)
        self.bodies["first"], self.bodies["nodes"] = self.ranges[:, 0], np.diff(self.ranges)[:, 0]
        own = sim.scene.solver
        self.bodies["tolerance"], self.bodies["max_iterations"] = own.tolerance, own.max_iterations
        for body, row in zip(sim.world.bodies, self.bodies, strict=True):
            settings = sim.engine.settings(body.index)
            row["position"], row["trust"], row["dx_dv"] = settings.position, settings.trust, settings.dx_dv
        self.bodies["warm_start"], self.bodies["kind"] = own.warm_start, KINDS.enumeration("Kind")["BLOCK_JACOBI"]

    def step(self) -> tuple[np.ndarray, np.ndarray]:
        """Makes a step; returns the solutions of both."""
        sim, a = self.sim, self.arrays
        rows = {name: getattr(self.contact, name).copy() for name in REMEMBERED}
        sim.engine.assemble()
        self.matrix = sim.engine.factor_matrix(0)
        self.gpu.renew()
        first = self.contact.body_start[-1]  # of those that the kernels detect
        for name, before in rows.items():
            self.gpu.twin(getattr(self.contact, name))[first:] = before[first:]
        self.balance["work"] = 0
        system = System(
            a["row_start"].ctypes.data, a["columns"].ctypes.data, self.ranges.ctypes.data,
            sim.scene.solver.tolerance, sim.scene.solver.max_iterations, len(self.ranges), self.passes.grid,
        )  # fmt: skip
        given = [c.c_void_p(x.ctypes.data) for x in (self.passes.params, self.passes.first, self.passes.later)]
        loops = self.library.step(*given, c.byref(system), *self.more())
        assert loops < 100 and not self.passes.active[0]
        sim.engine.solve()
        return self.gpu.twin(a["y"]), a["y"]

    def more(self) -> tuple[Any, ...]:
        """Arguments of a step beside those of contact with obstacles."""
        return ()

    def compare(self, rel: float) -> np.void:
        """Makes a step on both; returns the record of the first body."""
        slot = int(self.counter[0]) % 4
        ours, theirs = self.step()
        records, reactions = self.sim.engine.records_and_reactions()
        assert np.abs(ours - theirs).max() <= rel * np.abs(theirs).max()
        for name in ("contacts", "passes", "clipped"):
            assert (self.told[slot][name] == records[name]).all(), name
        assert (self.results[slot]["status"] == records["status"]).all()
        assert (np.abs(self.results[slot]["iterations"] - records["iterations"]) <= records["passes"] + 1).all()
        expected = pytest.approx(records["contact_residual"], rel=1e-3, abs=1e-9, nan_ok=True)
        assert self.told[slot]["residual"] == expected
        size = max(np.abs(self.contact.force).max(), 1e-9)
        for name in ("force", "traction"):
            host = getattr(self.contact, name)
            assert np.abs(self.gpu.twin(host) - host).max() <= 10 * rel * size, name
        assert np.abs(self.reactions[slot] - reactions).max() <= 10 * rel * max(np.abs(reactions).max(), 1e-9)
        work = records["work"] - self.work  # nothing else exerts any
        assert np.abs(self.balance["work"] - work).max() <= 10 * rel * max(np.abs(work).max(), 1e-9)
        self.work = records["work"].copy()
        self.counter += 1
        self.rounds = max(self.rounds, int(self.passes.memory["state"].view(CONTACT_STATE)["rounds"].max()))
        return records[0]
