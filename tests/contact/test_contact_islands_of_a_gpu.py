# SPDX-License-Identifier: MIT
"""Bodies that touch each other: the kernels of a GPU, run by threads of the processor, step by step against the loop of
the CPU."""

import ctypes as c
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_server.backends.compiler import INCLUDE, SOURCES, compiler
from sim_server.backends.gpu import islands as gpu_islands
from sim_server.backends.gpu.islands import TALLY
from sim_server.simulation import Simulation
from tests.contact import test_contact_passes_of_a_gpu as passes
from tests.contact.scenes import D, block, floor, over

TEXT = """
#include "pairs.cu"
#include "island.cu"
struct Islands { int bodies, grid, sites, most, pivots; };
static void each(int blocks, auto kernel) { launch(blocks, CONTACT_THREADS, kernel); }
static int island_pass(const IslandArguments& a, const Islands& s) {
    auto law = [&](int what) {
        each(s.bodies, [&] { island_law(a, what); });
        each(s.grid, [&] { island_balance(a, what); });
        each(s.most, [&] { island_decide(a, what); });
    };
    law(LAW);
    each(s.grid, [&] { island_prepare(a); });
    each(s.bodies, [&] { coarse_matrix(a); });
    for (int k = 0; k < s.pivots; ++k) each(s.bodies, [&] { invert_coarse(a, k); });
    int iterations = 0;
    for (; a.tally->iterating > 0 && iterations < 3000; ++iterations) {
        each(s.grid, [&] { island_update(a); });
        each(s.bodies, [&] { island_gather(a, 0); });
        each(s.grid, [&] { island_product(a); });
        each(s.bodies, [&] { coarse_solve(a); });
        each(s.grid, [&] { island_finish(a); });
        each(s.most, [&] { island_step(a); });
    }
    each(s.grid, [&] { island_update(a); });
    each(s.bodies, [&] { island_gather(a, 1); });
    each(s.grid, [&] { island_residual(a); });
    each(s.most, [&] { island_search(a); });
    each(s.grid, [&] { island_advance(a); });
    each(s.most, [&] { island_settle(a); });
    return iterations;
}
static void group(const IslandArguments& a, const Islands& s, int swept) {
    each(s.grid, [&] { look_at_bodies(a); });
    each(s.bodies, [&] { list_island_rows(a, swept); });
    launch(1, LISTING_THREADS, [&] { find_islands(a, swept); });
}
extern "C" void detect_pairs(const IslandArguments* p, const Islands* s) {
    const IslandArguments& a = *p;
    each(s->bodies, [&] { pair_boxes(a, 0); });
    each(s->bodies, [&] { pair_trees(a, 0); });
    each(s->sites, [&] { pair_sites(a); });
    group(a, *s, 0);
}
extern "C" int solve_islands(const IslandArguments* p, const Islands* s) {
    const IslandArguments& a = *p;
    int loops = 0;
    while (a.tally->go) {
        if (a.tally->active) {
            each(s->grid, [&] { place_entries(a); });
            each(s->bodies, [&] { fill_entries(a); });
            each(s->grid, [&] { island_start(a); });
            for (int what = WARM_START; what <= LAW_AT_START; ++what) {
                each(s->bodies, [&] { island_law(a, what); });
                each(s->grid, [&] { island_balance(a, what); });
                each(s->most, [&] { island_decide(a, what); });
            }
            for (; a.tally->active && loops < 500; ++loops) island_pass(a, *s);
        }
        each(s->bodies, [&] { pair_boxes(a, 1); });
        each(s->bodies, [&] { pair_trees(a, 1); });
        each(s->sites, [&] { pair_sweep(a); });
        launch(1, 1, [&] { end_sweep(a); });
        if (a.tally->go) group(a, *s, 1);
    }
    return loops;
}
extern "C" void keep_pairs_of_step(const IslandArguments* p, const Islands* s) {
    each(s->bodies, [&] { keep_pairs(*p); });
    each(s->grid, [&] { pair_work(*p); });
}
extern "C" void know_pairs_of_step(const IslandArguments* p, const Islands* s) {
    each(s->grid, [&] { know_pairs(*p, p->c.values); });
}
"""
STEP = """
extern "C" int step(const ContactArguments* c, const ContactSolve* first, const ContactSolve* pass, const System* s,
                    const IslandArguments* a, const Islands* islands) {
    int loops = 0;
    detect_pairs(a, islands);
    launch(s->bodies, CONTACT_THREADS, [&] { begin_contact(*c); });
    for (one_pass(*c, *first, *s); *c->active > 0 && loops < 200; ++loops) one_pass(*c, *pass, *s);
    solve_islands(a, islands);
    keep_pairs_of_step(a, islands);
    launch(s->grid, CONTACT_THREADS, [&] { finish_contact(*c); });
    know_pairs_of_step(a, islands);
    return loops;
}
"""


class Islands(c.Structure):
    _fields_ = [(name, c.c_int) for name in ("bodies", "grid", "sites", "most", "pivots")]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    folder = tmp_path_factory.mktemp("islands")
    for name, number, value in (("device_contact.cuh", "CONTACT_THREADS", 128), ("island_state.cuh", "LISTING_THREADS", 256)):
        text = (SOURCES / "backends/gpu" / name).read_text()
        shorter = text.replace(f"{number} = {value}", f"{number} = {passes.THREADS}")
        assert shorter != text
        (folder / name).write_text(shorter)
    for name in ("contact.cu", "pairs.cu", "island.cu"):
        (folder / name).write_text((SOURCES / "backends/gpu" / name).read_text())
    base = passes.TEXT[: passes.TEXT.index('extern "C" int step')].replace("#include <cstdio>", '#include "invert3.cuh"')
    (folder / "islands.cpp").write_text(base + TEXT + STEP)
    paths = [f"-I{p}" for p in (folder, passes.TESTS / "backends", SOURCES / "backends/gpu", INCLUDE)]
    command = [compiler(), "-std=c++20", "-O1", "-shared", "-fPIC", "-pthread", "-Dreal=double", *paths]
    subprocess.run([*command, str(folder / "islands.cpp"), "-o", str(folder / "islands.so")], check=True)
    return c.CDLL(str(folder / "islands.so"))


class IslandsBeside(passes.Beside):
    """Steps of bodies that touch each other."""

    def more(self) -> tuple[Any, ...]:
        islands = self.passes.islands
        assert islands is not None
        count, sites = len(self.ranges), len(self.contact.surfaces.site_body)  # type: ignore[union-attr]
        numbers = (count, self.passes.grid, -(-sites // passes.THREADS), max(count // 2, 1), islands._pivots)
        return c.c_void_p(islands.params.ctypes.data), c.byref(Islands(*numbers))


    def near(self, rel: float) -> Any:
        """Makes a step on both, which differ by what tolerances allow; returns the records."""
        slot = int(self.counter[0]) % 4
        ours, theirs = self.step()
        records, reactions = self.sim.engine.records_and_reactions()
        told, results = self.told[slot], self.results[slot]
        print(np.abs(ours - theirs).max() / np.abs(theirs).max(), told["passes"], records["passes"], results["iterations"], records["iterations"], told["contacts"], records["contacts"])
        assert np.abs(ours - theirs).max() <= rel * np.abs(theirs).max()
        for name in ("contacts", "clipped"):
            assert (told[name] == records[name]).all(), name
        assert (results["status"] == records["status"]).all()
        assert (np.abs(told["passes"] - records["passes"]) <= 2).all()
        size = max(np.abs(self.contact.force).max(), 1e-9)
        for name in ("force", "traction"):
            host = getattr(self.contact, name)
            assert np.abs(self.gpu.twin(host) - host).max() <= 100 * rel * size, name
        assert np.abs(self.reactions[slot] - reactions).max() <= 100 * rel * max(np.abs(reactions).max(), 1e-9)
        work = records["work"] - self.work
        print(self.balance["work"], work)
        assert np.abs(self.balance["work"] - work).max() <= 1e-3 * max(np.abs(work).max(), 1e-9)
        self.work = records["work"].copy()
        self.counter += 1
        return records


TIGHT: dict[str, Any] = {"preconditioner": "block_jacobi", "tolerance": 1e-11, "max_iterations": 3000}
HEIGHT = 0.04
CELLS, SIZE = (2, 1, 2), (0.08, 0.04, 0.08)


def pile(count: int, apart: float = D, **table: Any) -> Simulation:
    """Blocks one over another, each a little aside."""
    blocks = [
        block(cells=CELLS, size=SIZE, name=f"b{i}", at=(0.006 * (i % 2), D + i * (HEIGHT + apart), 0.004 * (i % 2)))
        for i in range(count)
    ]
    contact = {"thickness": D, "tolerance": 1e-8, "passes": 100}
    return over(objects=blocks, solver=TIGHT, contact=contact, **table)


def test_two_blocks(library, monkeypatch):
    beside = IslandsBeside(library, pile(2), monkeypatch)
    for _ in range(8):
        beside.near(1e-6)
