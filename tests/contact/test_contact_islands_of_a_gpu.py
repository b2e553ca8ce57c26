# SPDX-License-Identifier: MIT
"""Bodies that touch each other: the kernels of a GPU, run by threads of the processor, step by step against the loop of
the CPU."""

import ctypes as c
from typing import Any

import numpy as np
import pytest

from sim_server.backends.gpu.islands import ISLAND, TALLY, tree_heights
from sim_server.backends.kinds import KINDS
from sim_server.effects import contact
from sim_server.simulation import Simulation
from tests.contact.kernels_beside import TEXT, Beside, compiled
from tests.contact.scenes import D, block, floor, over


@pytest.fixture(autouse=True)
def nodes_alone(monkeypatch):
    """On a GPU triangles and edges have no rows: here they have none on the CPU beside it, either."""
    monkeypatch.setattr(contact, "nodes_alone", lambda world: True)


ISLANDS = """
#include "pairs.cu"
#include "island.cu"
struct Islands { int bodies, grid, sites, most, pivots, product_grid; };
// In place of island_factor: what stands for a factor does nothing.
static void apply_factors(const IslandArguments& a) {
    for (int body = 0; body < a.bodies_count; ++body) {
        const int island = island_of(a, body);
        if (island < 0 || a.state[island].stage != ITERATES || !a.state[island].factors) continue;
        const int first = a.bodies[body].first, last = first + a.bodies[body].nodes;
        for (int k = 3 * first; k < 3 * last && has_factor(a.bodies[body]); ++k) a.z[k] = a.r[k];
    }
}
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
        apply_factors(a);
        each(s.bodies + s.product_grid, [&] { island_multiply(a, 0); });
        each(s.grid, [&] { island_product(a); });
        each(s.bodies, [&] { coarse_solve(a); });
        each(s.grid, [&] { island_finish(a); });
    }
    each(s.grid, [&] { island_update(a); });
    each(s.bodies + s.product_grid, [&] { island_multiply(a, 1); });
    each(s.grid, [&] { island_residual(a); });
    launch(s.most, SEARCH_THREADS, [&] { island_search(a); });
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
    _fields_ = [(name, c.c_int) for name in ("bodies", "grid", "sites", "most", "pivots", "product_grid")]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("islands"), TEXT + ISLANDS + STEP)


class IslandsBeside(Beside):
    """Steps of bodies that touch each other."""

    def more(self) -> tuple[Any, ...]:
        islands = self.passes.islands
        assert islands is not None
        count = len(self.ranges)
        numbers = (
            count,
            self.passes.grid,
            islands.vertex_grid,
            max(count // 2, 1),
            islands.pivots,
            islands.product_grid,
        )
        return c.c_void_p(islands.params.ctypes.data), c.byref(Islands(*numbers))

    @property
    def tally(self) -> np.void:
        """What the kernels count."""
        islands = self.passes.islands
        assert islands is not None
        return islands.tally.view(TALLY)[0]  # type: ignore[no-any-return]

    def near(self, rel: float) -> Any:
        """Makes a step on both, which differ by what tolerances allow; returns the records."""
        slot = int(self.counter[0]) % 4
        ours, theirs = self.step()
        records, reactions = self.sim.engine.records_and_reactions()
        told, results = self.told[slot], self.results[slot]
        assert np.abs(ours - theirs).max() <= rel * np.abs(theirs).max()
        for name in ("contacts", "clipped"):
            assert (told[name] == records[name]).all(), name
        assert (results["status"] == records["status"]).all()
        assert (np.abs(told["passes"] - records["passes"]) <= 4).all()
        size = max(np.abs(self.contact.force).max(), 1e-9)
        for name in ("force", "traction"):
            host = getattr(self.contact, name)
            assert np.abs(self.gpu.twin(host) - host).max() <= 100 * rel * size, name
        assert np.abs(self.reactions[slot] - reactions).max() <= 100 * rel * max(np.abs(reactions).max(), 1e-9)
        work = records["work"] - self.work
        assert np.abs(self.balance["work"] - work).max() <= 1e-3 * max(np.abs(work).max(), 1e-9)
        self.work = records["work"].copy()
        self.counter += 1
        return records


TIGHT: dict[str, Any] = {"preconditioner": "block_jacobi", "tolerance": 1e-11, "max_iterations": 3000}
HEIGHT = 0.04
CELLS, SIZE = (2, 1, 2), (0.08, 0.04, 0.08)


CONTACT: dict[str, Any] = {"thickness": D, "tolerance": 1e-8, "passes": 100}


def pile(count: int, apart: float = D, **table: Any) -> Simulation:
    """Blocks one over another, each a little aside."""
    blocks = [
        block(cells=CELLS, size=SIZE, name=f"b{i}", at=(0.006 * (i % 2), D + i * (HEIGHT + apart), 0.004 * (i % 2)))
        for i in range(count)
    ]
    return over(objects=blocks, solver=TIGHT, contact=CONTACT, **table)


def collision(speed: float) -> Simulation:
    """Two blocks that meet in free space, one turned, and one alone."""
    blocks = [
        block(cells=CELLS, size=SIZE, name="one"),
        block(cells=CELLS, size=SIZE, name="other", at=(0.03, 0.06, 0.02), rotate=(10, 30, 5)),
        block(cells=CELLS, size=SIZE, name="alone", at=(2, 0, 0)),
    ]
    sim = over(
        floor(pose={"translate": [0, -100, 0]}), objects=blocks, gravity=(0, 0, 0), contact=CONTACT, solver=TIGHT
    )
    one, other, _ = sim.world.bodies
    sim.world.v[one.nodes], sim.world.v[other.nodes] = (0, speed, 0), (0.2 * speed, -speed, 0)
    return sim


def test_two_blocks_are_set_down(library, monkeypatch):
    beside = IslandsBeside(library, pile(2), monkeypatch)
    records = np.array([beside.near(1e-6) for _ in range(6)])
    assert (records["contacts"][-1] > 0).all() and records["passes"].max() > 3


def test_a_stack_of_four(library, monkeypatch):
    beside = IslandsBeside(library, pile(4, velocity=(0.3, 0, 0)), monkeypatch)
    for _ in range(3):
        assert (beside.near(1e-6)["contacts"] > 0).all()
    assert beside.tally["islands"] == 1 and beside.tally["alone"] == 0


def test_islands_side_by_side_and_one_alone(library, monkeypatch):
    """They go in step, each at its own pace."""
    blocks = [
        block(cells=CELLS, size=SIZE, name=f"b{k}", at=(0.2 * (k % 3), D + (HEIGHT + 0.7 * D) * (k // 3), 0))
        for k in range(5)
    ]
    beside = IslandsBeside(library, over(objects=blocks, contact=CONTACT, solver=TIGHT), monkeypatch)
    passes = np.array([beside.near(1e-6)["passes"] for _ in range(4)])
    assert beside.tally["islands"] == 2 and beside.tally["alone"] == 1
    assert (passes.max(axis=1) > passes.min(axis=1)).any()


@pytest.mark.parametrize("speed", [0.5, 4.0])
def test_blocks_collide_and_one_is_alone(library, monkeypatch, speed):
    """Also so fast that the paths found pass through the other, and bodies that were solved alone are solved again."""
    beside = IslandsBeside(library, collision(speed), monkeypatch)
    before = beside.sim.world.mass @ beside.sim.world.v
    sweeps = contacts = 0
    for _ in range(6 if speed < 1 else 3):
        contacts += beside.near(1e-5)["contacts"].sum()
        sweeps += beside.tally["rounds"]
    assert contacts > 0 and (sweeps > 0) == (speed > 1)
    after = beside.sim.world.mass @ beside.sim.world.v
    assert abs(after - before).max() <= 1e-9 * beside.sim.world.mass.sum() * speed


def test_momentum_of_the_kernels_solution(library, monkeypatch):
    """What one body gets the other gives: with m y = sum of i f the solution itself has no momentum."""
    beside = IslandsBeside(library, collision(1.0), monkeypatch)
    world = beside.sim.world
    for _ in range(4):
        before = world.mass @ world.v
        rotation = beside.arrays["rotation"]
        ours, _ = beside.step()
        beside.counter += 1
        change = np.einsum("n,nij,nj->i", world.mass, rotation, ours)
        predicted = world.mass @ world.predictor
        assert abs(predicted + change - before).max() <= 1e-9 * world.mass.sum()


def test_a_copy_of_the_matrix_knows_contacts_between_bodies(library, monkeypatch):
    """As on a CPU: those that carried force in the step before, in the body's own blocks, also off the diagonal."""
    beside = IslandsBeside(library, pile(2), monkeypatch)
    values = beside.arrays["values"]
    for step in range(3):
        beside.near(1e-6)
        ours = beside.gpu.twin(values)[: len(beside.matrix)]
        assert np.abs(ours - beside.matrix).max() <= 1e-9 * np.abs(values).max()
        assert (np.abs(beside.matrix - values[: len(beside.matrix)]).max() > 0) == (step > 0)


def test_rows_of_a_body_whose_forces_are_not_finite_go(library, monkeypatch):
    beside = IslandsBeside(library, pile(3), monkeypatch)
    beside.near(1e-6)
    beside.sim.world.v[beside.sim.world.bodies[2].nodes] = np.nan
    beside.step()
    assert beside.tally["islands"] == 1 and beside.tally["alone"] == 1
    first = beside.sim.world.bodies[2].first
    y, ours = beside.arrays["y"], beside.gpu.twin(beside.arrays["y"])
    assert np.isfinite(y[:first]).all() and abs(ours[:first] - y[:first]).max() <= 1e-6 * abs(y[:first]).max()


def test_an_island_goes_over_to_block_jacobi(library, monkeypatch):
    """Factors that are of little use are left within a pass, and passes then begin without them."""
    beside = IslandsBeside(library, pile(2), monkeypatch)
    kinds = KINDS.enumeration("Kind")
    beside.bodies["kind"], beside.bodies["plan"] = kinds["CHOLESKY"], 1
    beside.near(1e-6)
    islands = beside.passes.islands
    assert islands is not None
    choice = islands.memory["choice"].view(ISLAND.dtype("PassChoice"))[0]
    assert choice["jacobi"] == 1 and choice["rate"][0] > choice["rate"][1] > 0
    assert (beside.results[0]["kind"] == kinds["BLOCK_JACOBI"]).all()


def test_heights_of_boxes_over_triangles():
    sim = pile(2)
    surfaces = sim.contact.contact_input().surfaces
    height, child = tree_heights(surfaces), surfaces.tree_child
    inner = child[:, 0] >= 0
    assert (height[~inner] == 0).all() and (height[inner] == 1 + height[child[inner]].max(axis=1)).all()
