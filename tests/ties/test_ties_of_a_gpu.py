# SPDX-License-Identifier: MIT
"""Attachments and springs: the kernels of a GPU, run by threads of the processor, step by step against the loop of the
CPU."""

import ctypes as c
from typing import Any

import numpy as np
import pytest

from sim_server.backends.gpu.faces import DEFINED
from sim_server.backends.gpu.tie_arguments import bindings
from tests.contact.kernels_beside import TEXT, compiled
from tests.contact.test_contact_islands_of_a_gpu import ISLANDS, Islands, IslandsBeside
from tests.scenes import bar
from tests.ties.test_attachments_and_springs import FLOOR, glue, made

STEP = """
#include "ties.cu"
extern "C" int step(const ContactArguments* c, const ContactSolve* first, const ContactSolve* pass, const System* s,
                    const IslandArguments* a, const Islands* islands) {
    const int items = a->bound_nodes > a->ties.count ? a->bound_nodes : a->ties.count;
    int loops = 0;
#ifdef FACE_ROWS
    each_triangle(*c, [&] { detect_faces(*c); });
#endif
    if (islands->sites) detect_pairs(*a, *islands);
    each((items + CONTACT_THREADS - 1) / CONTACT_THREADS, [&] { begin_ties(*a); });
    each(islands->edges, [&] { bind_edges(*a); });
    group(*a, *islands, 0);
    each(s->bodies, [&] { begin_contact(*c); });
    for (one_pass(*c, *first, *s); *c->active > 0 && loops < 200; ++loops) one_pass(*c, *pass, *s);
    solve_islands(a, islands);
    keep_pairs_of_step(a, islands);
#ifdef FACE_ROWS
    each(s->bodies, [&] { finish_faces(*c); });
#endif
    each(s->grid, [&] { finish_contact(*c); });
    know_pairs_of_step(a, islands);
    each(a->ties.tables, [&] { keep_ties(*a); });
    return loops;
}
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("ties"), TEXT + ISLANDS + STEP, "-DTIES")


@pytest.fixture(scope="module")
def library_with_triangles(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("ties"), TEXT + ISLANDS + STEP, "-DTIES", DEFINED)


class TiesBeside(IslandsBeside):
    """Steps of a scene with attachments or springs."""

    def more(self) -> tuple[Any, ...]:
        islands, count = self.passes.islands, len(self.ranges)
        assert islands is not None
        sites = islands.vertex_grid if self.contact.surfaces else 0
        numbers = (count, self.passes.grid, sites, count, islands.pivots, islands.product_grid, islands.edge_grid)
        return c.c_void_p(islands.params.ctypes.data), c.byref(Islands(*numbers))

    def same(self, rel: float) -> np.void:
        """Makes a step on both, which differ by what tolerances allow; returns the records."""
        ties, slot = self.contact.ties, int(self.counter[0]) % 4
        assert ties is not None
        ours, theirs = self.step()
        records, reactions = self.sim.engine.records_and_reactions()
        told, results = self.told[slot], self.results[slot]
        assert np.abs(ours - theirs).max() <= rel * np.abs(theirs).max()
        assert (told["contacts"] == records["contacts"]).all() and (told["clipped"] == records["clipped"]).all()
        assert (results["status"] == records["status"]).all()
        assert (np.abs(told["passes"] - records["passes"]) <= 1).all()
        assert (self.gpu.twin(ties.broken) == ties.broken).all() and (self.broken == ties.broken).all()
        assert self.gpu.twin(ties.stiffness).tolist() == ties.stiffness.tolist()
        size = max(np.abs(ties.force).max(), 1e-3)
        assert np.abs(self.gpu.twin(ties.force) - ties.force).max() <= 100 * rel * size
        own, expected = (array[:, ties.column :] for array in (self.gpu.twin(ties.reaction), ties.reaction))
        assert np.abs(own - expected).max() <= 100 * rel * max(np.abs(expected).max(), 1e-3)
        obstacles = self.reactions.shape[2]
        apart = np.abs(self.reactions[slot] - reactions[-len(records) :, :obstacles])
        assert apart.max(initial=0) <= 100 * rel * max(np.abs(reactions).max(), 1e-3)
        work = records["work"] - self.work
        if "gravity" not in self.sim.scene.effects:  # ties alone exert work
            assert np.abs(self.balance["work"] - work).max() <= 1e-3 * max(np.abs(work).max(), 1e-9)
        self.work = records["work"].copy()
        self.counter += 1
        return records


def piece(name: str, x: float, fixed: str | None = None, **keys: Any) -> dict:
    """A bar of 1 m along x that begins at x."""
    keys |= {"fixed": fixed} if fixed else {}
    return bar((2, 1, 1), (1, 0.5, 0.5), name=name, pose={"translate": [x, 0, 0]}, **keys)


def test_a_spring_pulls_free_bodies_and_breaks(library, monkeypatch):
    """It is stretched and slack, each body has rigid motions, and nothing else acts; then each is alone."""
    ends = [{"object": "a", "at": [1, 0.5, 0.5]}, {"object": "b", "at": [0, 0, 0.5]}]
    spring = {"name": "band", "between": ends, "stiffness": 5e4, "rest_length": 0.6, "breaking": 440.0}
    beside = TiesBeside(library, made(piece("a", 0), piece("b", 1.3), gravity=False, spring=[spring]), monkeypatch)
    beside.sim.world.v[beside.sim.world.bodies[1].nodes] = [2.0, 0.3, 0]
    for _ in range(6):
        beside.same(1e-8)
    assert beside.contact.ties.broken.tolist() == [4] and beside.tally["islands"] == 0 and beside.tally["alone"] == 2


def test_a_spring_within_a_body_and_one_body_alone(library, monkeypatch):
    """A body that nothing else touches is an island by its spring; its matrix for a factor knows it where it can."""
    ends = [{"object": "a", "at": [0, 0, 0]}, {"object": "a", "at": [1, 0.5, 0.5]}]
    spring = {"name": "band", "between": ends, "stiffness": 5e4, "rest_length": 0.8}
    objects = piece("a", 0), piece("b", 3)
    beside = TiesBeside(library, made(*objects, spring=[spring]), monkeypatch)
    for _ in range(3):
        beside.same(1e-8)
    assert beside.tally["islands"] == 1 and beside.tally["alone"] == 1
    ours = beside.gpu.twin(beside.arrays["values"])[: len(beside.matrix)]
    assert np.abs(ours - beside.matrix).max() <= 1e-12 * np.abs(beside.matrix).max()
    assert np.abs(beside.matrix - beside.arrays["values"][: len(beside.matrix)]).max() > 0


def test_glued_bars_tear(library, monkeypatch):
    """Nodes of unequal meshes; node after node breaks."""
    small = bar((2, 2, 1), (1, 0.5, 0.5), name="b", pose={"translate": [1, 0, 0]})
    sim = made(piece("a", 0, "X < 0.01"), small, attachment=[glue(breaking=160.0)])
    sim.world.v[sim.world.bodies[1].nodes] = [0.3, -0.5, 0]
    beside, broken = TiesBeside(library, sim, monkeypatch), []
    for _ in range(4):
        beside.same(1e-8)
        broken.append(int((beside.contact.ties.broken > 0).sum()))
    assert 0 < broken[0] < len(beside.contact.ties.broken)


def test_attachments_to_an_obstacle_and_between_bodies_in_contact(library_with_triangles, monkeypatch):
    """With contact: a moving tool holds one bar, which a floor and another bar touch; glued nodes have no contact."""
    keys = [{"time": 0, "translate": [0, 2, 0]}, {"time": 0.5, "translate": [0.1, 2.1, 0], "rotate": [0, 0, 30]}]
    tool = {"name": "tool", "shape": "sphere", "radius": 0.1, "keyframes": keys}
    floor = FLOOR | {"pose": {"translate": [0, -0.01, 0]}}
    stuck = {"name": "stuck", "object": "a", "where": "X < 0.01", "to": "tool"}
    effect = {"thickness": 0.02, "tolerance": 1e-5, "passes": 100}
    objects = piece("a", 0), piece("b", 1), piece("c", 2.015)
    sim = made(*objects, obstacle=[floor, tool], attachment=[stuck, glue()], contact=effect)
    sim.world.v[sim.world.bodies[2].nodes] = [-1.0, 0, 0]
    beside = TiesBeside(library_with_triangles, sim, monkeypatch)
    records = np.array([beside.same(1e-4) for _ in range(2)])
    assert records["contacts"].max() > 0 and beside.tally["islands"] == 1 and not records["clipped"].any()
    assert (beside.gpu.twin(beside.contact.obstacle) == beside.contact.obstacle).all()


def test_glued_bars_that_fall_far_in_a_step_do_not_touch_each_other(library, monkeypatch):
    """Neither before the solve nor in the sweep after it: by half an element in a step, together."""
    far = FLOOR | {"pose": {"translate": [0, -90, 0]}}
    sim = made(piece("a", 0), piece("b", 1), attachment=[glue()], obstacle=[far])
    sim.world.v[:] = (0, -12, 0)
    beside = TiesBeside(library, sim, monkeypatch)
    for _ in range(2):
        assert beside.same(1e-8)["passes"].max() <= 1
    assert beside.tally["rounds"] == 0 and (beside.gpu.twin(beside.contact.obstacle)[:-6] == -1).all()


def test_what_nodes_may_be_bound_to_is_listed_in_order():
    sim = made(piece("a", 0), piece("b", 1), piece("c", 2), attachment=[glue(), glue(name="other", object="c", to="b")])
    node, start, tie, other = bindings(sim.ties)
    assert (np.diff(node) > 0).all() and start[0] == 0 and start[-1] == len(tie) == len(other)
    for k, first in enumerate(node):
        own = tie[start[k] : start[k + 1]]
        assert (np.diff(own) > 0).all() and (sim.ties.corner[own] == first).any(axis=1).all()
        where = sim.ties.corner[own] == first
        expected = [sim.ties.body[i, int(w[0])] for i, w in zip(own, where, strict=True)]
        assert other[start[k] : start[k + 1]].tolist() == expected
