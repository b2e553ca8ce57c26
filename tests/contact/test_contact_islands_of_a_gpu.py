# SPDX-License-Identifier: MIT
"""Bodies that touch each other: the kernels of a GPU, run by threads of the processor, step by step against the loop of
the CPU."""

import ctypes as c
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from sim_server.backends.gpu.faces import DEFINED
from sim_server.backends.gpu.island_memory import ISLAND, TALLY, tree_heights
from sim_server.backends.gpu.structs import PAIR_SUM
from sim_server.backends.kinds import KINDS
from sim_server.simulation import Simulation
from tests.contact.kernels_beside import TEXT, Beside, compiled
from tests.contact.scenes import D, block, floor, over
from tests.contact.test_contact_edges import crossed
from tests.contact.test_contact_held_apart import crushed, thrown
from tests.contact.test_contact_triangles import SMALL, obstacle

ISLANDS = """
#include "pairs.cu"
#include "island.cu"
struct Islands { int bodies, grid, sites, most, pivots, product_grid, edges; };
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
#ifdef FACE_ROWS
    each_triangle(a.c, [&] { sweep_island_faces(a); });
#endif
    each(s.most, [&] { island_settle(a); });
    return iterations;
}
static void group(const IslandArguments& a, const Islands& s, int swept) {
    each(s.grid, [&] { look_at_bodies(a); });
    each(s.bodies, [&] { list_island_rows(a, swept); });
    launch(1, LISTING_THREADS, [&] { find_islands(a, swept); });
}
static void detect_pairs(const IslandArguments& a, const Islands& s) {
    each(s.bodies, [&] { pair_boxes(a, 0); });
    each(s.bodies, [&] { pair_trees(a, 0); });
    each(s.sites, [&] { pair_sites(a); });
    each(s.edges, [&] { pair_edges(a); });
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
        if (s->sites) {
            each(s->bodies, [&] { pair_boxes(a, 1); });
            each(s->bodies, [&] { pair_trees(a, 1); });
            each(s->sites, [&] { pair_sweep(a); });
            each(s->edges, [&] { edge_sweep(a); });
        }
        launch(1, LISTING_THREADS, [&] { end_sweep(a); });
        if (a.tally->again) group(a, *s, 1);
    }
    return loops;
}
extern "C" void keep_pairs_of_step(const IslandArguments* p, const Islands* s) {
    if (s->sites) each(s->bodies, [&] { keep_pairs(*p); });
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
#ifdef FACE_ROWS
    each_triangle(*c, [&] { detect_faces(*c); });
#endif
    detect_pairs(*a, *islands);
    group(*a, *islands, 0);
    launch(s->bodies, CONTACT_THREADS, [&] { begin_contact(*c); });
    for (one_pass(*c, *first, *s); *c->active > 0 && loops < 200; ++loops) one_pass(*c, *pass, *s);
    solve_islands(a, islands);
    keep_pairs_of_step(a, islands);
#ifdef FACE_ROWS
    launch(s->bodies, CONTACT_THREADS, [&] { finish_faces(*c); });
#endif
    launch(s->grid, CONTACT_THREADS, [&] { finish_contact(*c); });
    know_pairs_of_step(a, islands);
    return loops;
}
"""


class Islands(c.Structure):
    _fields_ = [(name, c.c_int) for name in ("bodies", "grid", "sites", "most", "pivots", "product_grid", "edges")]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("islands"), TEXT + ISLANDS + STEP)


@pytest.fixture(scope="module")
def with_triangles(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("triangles"), TEXT + ISLANDS + STEP, DEFINED)


class IslandsBeside(Beside):
    """Steps of bodies that touch each other.

    seen: reactions that were compared. singles: a body alone may be an island
    """

    seen, singles = 0, False

    def more(self) -> tuple[Any, ...]:
        islands = self.passes.islands
        assert islands is not None
        count = len(self.ranges)
        numbers = (
            count,
            self.passes.grid,
            islands.vertex_grid,
            count if self.singles else max(count // 2, 1),
            islands.pivots,
            islands.product_grid,
            islands.edge_grid,
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
        apart = np.abs(self.reactions[slot] - reactions)
        assert apart.max(initial=0) <= 100 * rel * np.abs(reactions).max(initial=1e-9)
        self.pairs_are_told(slot, 100 * rel * size)
        work = records["work"] - self.work
        assert np.abs(self.balance["work"] - work).max() <= 1e-3 * max(np.abs(work).max(), 1e-9)
        self.work = records["work"].copy()
        self.counter += 1
        return records

    def pairs_are_told(self, slot: int, near: float) -> None:
        """Sums over rows are those of which the CPU has made what bodies exert on each other."""
        sums, counts = self.pairs
        ours = {(i, s["other"]): s for i, count in enumerate(counts[slot]) for s in sums[slot, i, :count]}
        told = self.sim.engine.other_reactions()
        assert {frozenset(pair) for pair in ours} == {frozenset((r["body"], r["number"])) for r in told}
        none = np.zeros((), PAIR_SUM)
        for r in told:
            own, back = (ours.get(pair, none) for pair in ((r["body"], r["number"]), (r["number"], r["body"])))
            assert np.abs(back["force"] - own["force"] - r["force"]).max() <= near
            point = (own["point"] + back["point"]) / (own["normal"] + back["normal"])
            assert np.abs(point - r["point"]).max() <= 1e-6
            torque = back["torque"] - own["torque"] - np.cross(point, back["force"] - own["force"])
            assert np.abs(torque - r["torque"]).max() <= near
        self.seen += len(told)


STATUS = KINDS.enumeration("Status")
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
    assert (records["contacts"][-1] > 0).all() and records["passes"].max() > 3 and beside.seen > 0


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


def edge_rows(beside: IslandsBeside) -> int:
    surfaces = beside.contact.surfaces
    assert surfaces is not None
    return int((beside.contact.force[surfaces.edge_start[0] :] > 0).sum())


@pytest.mark.parametrize("stiffness", [1.0, 0.01])
def test_edges_that_cross_between_their_nodes(library, monkeypatch, stiffness):
    """Also so soft ones that a sweep finds them passing."""
    sim = crossed(3.0, contact=CONTACT | {"stiffness": stiffness}, solver=TIGHT)
    beside, used, sweeps = IslandsBeside(library, sim, monkeypatch), 0, 0
    for _ in range(2):
        beside.near(1e-6)
        used, sweeps = max(used, edge_rows(beside)), sweeps + beside.tally["rounds"]
    assert used > 0 and (sweeps > 0) == (stiffness < 1)


def test_nodes_that_are_set_back_are_told_of_their_own_body(library, monkeypatch):
    """As on the CPU, and so is the status: the other one, solved with it, ends where the solve did."""
    blocks = [
        block(cells=CELLS, size=SIZE, name="low", at=(0, 2 * D, 0)),
        block(cells=CELLS, size=SIZE, name="high", at=(0.01, 2.5 * D + HEIGHT, 0.005)),
    ]
    soft = {"thickness": D, "tolerance": 0.9, "passes": 1, "stiffness": 1e-4}
    sim = over(objects=blocks, solver=TIGHT, contact=soft)
    sim.world.v[sim.world.bodies[0].nodes] = (0, -6, 0)
    beside = IslandsBeside(library, sim, monkeypatch)
    records = beside.near(1e-3)
    assert beside.tally["islands"] == 1 and records["passes"].all()
    assert records["clipped"][0] > 0 and records["clipped"][1] == 0
    assert records["status"].tolist() == [STATUS["CONTACT"], STATUS["CONVERGED"]]


def test_obstacles_hold_back_what_was_held_apart(library, monkeypatch):
    """In this order, as on the CPU: what is held apart is not taken into the floor by that."""
    sim = crushed(solver=TIGHT, passes=30, stiffness=1e-6)
    beside, apart = IslandsBeside(library, sim, monkeypatch), 0
    for _ in range(2):
        slot = int(beside.counter[0]) % 4
        ours, theirs = beside.step()
        beside.counter += 1
        assert np.abs(ours - theirs).max() <= 1e-6 * np.abs(theirs).max()
        told = beside.told[slot]["clipped"]
        assert told.tolist() == sim.engine.records()["clipped"].tolist()
        assert sim.world.x[:, 1].min() > 0
        apart += beside.tally["holds"]
    assert apart > 0


@pytest.mark.parametrize("what", ["vertices", "edges"])
def test_what_still_passes_is_held_apart(library, monkeypatch, what):
    """Contacts with hardly any stiffness; on both sides by their masses, as on the CPU, which keeps momentum."""
    soft = {"thickness": D, "tolerance": 1e-8, "passes": 30, "stiffness": 1e-6}
    sim = thrown(6.0, **soft) if what == "vertices" else crossed(3.0, contact=soft, solver=TIGHT)
    beside, world, clipped = IslandsBeside(library, sim, monkeypatch), sim.world, 0
    for _ in range(2):
        before = world.mass @ world.v
        slot, rotation = int(beside.counter[0]) % 4, beside.arrays["rotation"]
        ours, theirs = beside.step()
        beside.counter += 1
        assert np.abs(ours - theirs).max() <= 1e-4 * np.abs(theirs).max()
        records = beside.sim.engine.records()
        told = beside.told[slot]["clipped"]
        assert told.tolist() == records["clipped"].tolist()
        clipped += told.sum()
        change = np.einsum("n,nij,nj->i", world.mass, rotation, ours)
        assert abs(world.mass @ world.predictor + change - before).max() <= 1e-9 * world.mass.sum()
    assert clipped > 0


@pytest.mark.parametrize("speed", [0.0, 8.0])
def test_triangles_of_bodies_that_touch_each_other(with_triangles, monkeypatch, speed):
    """A block on a spike, which carries another one, or is thrown onto it with that; a third one is alone on a ball."""
    small = SMALL | {"cells": (2, 1, 2), "size": (0.1, 0.05, 0.1)}
    low = 0.5 * D if speed == 0 else 0.05
    places = {"low": (0, low, 0), "high": (0.01, low + 0.05 + 0.5 * D, 0.004), "alone": (2, low, 0)}
    blocks = [block(name=name, **small | {"at": at}) for name, at in places.items()]
    ball = obstacle("ball") | {"pose": {"translate": [2.062, -0.005, 0.029]}}
    sim = over(
        obstacle("corner"), ball, objects=blocks, contact=CONTACT, solver=TIGHT, velocity=(0.1 * speed, -speed, 0)
    )
    beside, used = IslandsBeside(with_triangles, sim, monkeypatch), 0
    faces = beside.contact.faces
    assert faces is not None
    for _ in range(2):
        beside.near(1e-6)
        force = [(beside.contact.force[first:last] > 0).any() for first, last in pairwise(faces.start)]
        used += force[0] + 2 * force[2]
        matrix, values = beside.matrix, beside.gpu.twin(beside.arrays["values"])[: len(beside.matrix)]
        assert np.abs(values - matrix).max() <= 1e-9 * np.abs(matrix).max()
    assert used >= 3 and beside.tally["islands"] == 1


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
