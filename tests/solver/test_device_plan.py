# SPDX-License-Identifier: MIT
"""backends/gpu/inverse/device_plan.py: the lists that the kernel reads, applied in NumPy as it applies them."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.gpu.inverse import plan as plans
from sim_server.backends.gpu.inverse.device_plan import DevicePlan
from sim_server.backends.gpu.inverse.halves import FAR_READS, FORMED_FAR, NEAR_READS, RESIDUAL_FAR, FarFlags
from sim_server.backends.gpu.inverse.partition import tree_of
from sim_server.backends.gpu.inverse.plan import lay_out, plan
from sim_server.backends.gpu.row_partition import assign_blocks, best_assignment, busiest, halo, initial_ranges
from tests.reference.partitioned import stored
from tests.solver.test_partitioned_inverse import GRAPHS, graphs, system
from tests.worker.block_matrices import bar_edges, pattern


class HostGpu:
    """Arrays stay where they are."""

    class cp:
        zeros = staticmethod(np.zeros)

        @staticmethod
        def asarray(array: NDArray) -> SimpleNamespace:
            return SimpleNamespace(data=SimpleNamespace(ptr=1), host=array)


def applied(uploaded: DevicePlan, chunks: NDArray, scale: NDArray, r: NDArray) -> NDArray:
    """z of r, by phases and thread blocks: partitioned_inverse.cuh without its words."""
    return applied_by([(uploaded, 0, uploaded.plan.blocks)], chunks, scale, r)


def applied_by(devices: list[tuple[DevicePlan, int, int]], chunks: NDArray, scale: NDArray, r: NDArray) -> NDArray:
    """The same by devices, each with its own copy of plan and vectors, in which it has what is put there, and with the
    matrices of its own thread blocks. devices: plan, first thread block and last."""
    p = devices[0][0].plan
    lists_of = [{name: array.host for name, array in each.arrays.items()} for each, _, _ in devices]
    at = ((lists_of[0]["place"] & ~RESIDUAL_FAR)[:, None] + np.arange(3)).ravel()
    vectors = [
        {name: np.full(p.size + 32, np.nan) for name in ("residual", "formed", "solved")}
        | {"contributed": np.full(len(p.slots) + 32, np.nan)}
        for _ in devices
    ]
    for device, own in enumerate(vectors):
        own["residual"][[k for k in range(p.size + 32) if k not in set(at.tolist())]] = 0
        there = np.repeat((lists_of[0]["place"] & RESIDUAL_FAR > 0) | (device == 0), 3)
        own["residual"][at[there]] = (scale[at] * r)[there]
        own["solved"][p.size :] = 0
    z = np.full(p.size + 32, np.nan)
    for phase in range(p.phases):
        forward = phase < p.groups - 1
        areas: dict[int, NDArray] = {}
        for forming in (True, False):
            for device, (_, first, last) in enumerate(devices):
                for block in range(first, last):
                    areas[block] = _area(p, lists_of[device], phase, block, forming, vectors, device)
        puts: list[tuple[int, int, float, bool]] = []
        for device, (_, first, last) in enumerate(devices):
            mine = np.full_like(chunks, np.nan)
            mine[p.chunk_start[first] : p.chunk_start[last]] = chunks[p.chunk_start[first] : p.chunk_start[last]]
            for block in range(first, last):
                puts += [(device, *each) for each in _products(p, lists_of[device], phase, block, mine, areas[block])]
        for device, i, v, elsewhere in puts:
            if not forward:
                for own in vectors if elsewhere else [vectors[device]]:
                    own["solved"][i] = v
                z[i] = v
                assert np.isfinite(vectors[device]["residual"][i])
                continue
            target = int(lists_of[device]["target"][i])
            if len(devices) == 1:
                vectors[0]["contributed"][target] = v
            for reader, flag in ((device, NEAR_READS), (1 - device, FAR_READS)):
                if target & flag:
                    vectors[reader]["contributed"][target & NEAR_READS - 1] = v
    return scale[:-1][at] * z[at]


def _area(p, a, phase, block, forming, vectors, device):
    own, part, lists = vectors[device], a["block_ranges"][block], a["lists"][block]
    own_segments = a["segments"][part[0] : part[0] + part[1]]
    where = a["index"][part[0] : part[0] + part[1]]
    x = np.full(p.x_area, np.nan)
    middle = lists[2 * p.phases + 2 + phase] if phase < p.groups else lists[phase]
    for k in range(lists[phase], middle if forming else lists[phase + 1]):
        kind, begin, to, keep = own_segments[k]
        valid = np.arange(32) < keep >> 1
        assert (kind & 3 == 0) == (k < middle)
        if kind & 3 == 0:
            v = own["residual"][begin : begin + 32].copy()
            low, many = where[k] & 0xFFFFFF, where[k].view(np.uint32) >> 24
            v -= [own["contributed"][first : first + count].sum() for first, count in zip(low, many, strict=True)]
            if keep & 1 and forming:
                for each in vectors if kind & FORMED_FAR else [own]:
                    each["formed"][begin : begin + 32] = np.where(valid, v, 0)
        else:
            v = own["formed" if kind == 1 else "solved"][where[k]]
        x[to : to + 32] = np.where(valid, v, 0)
    return x


def _products(p, a, phase, block, chunks, x):
    part, lists = a["block_ranges"][block], a["lists"][block]
    starts, chunks_before = lists[p.phases + 1 : 2 * p.phases + 2], 0
    for t in range(starts[phase], starts[phase + 1]):
        chunk, to, count, out, rows, elsewhere, before = a["tiles"][part[2] + t][:7]
        assert before == chunks_before
        chunks_before += count
        assert part[4] <= chunk and chunk + (rows // 8) * count * p.planes <= part[4] + part[5]
        for eight in range(rows // 8):
            tile = chunks[chunk + eight * count * p.planes :][:count]
            value = np.einsum("crk,ck->r", tile, x[to : to + 32 * count].reshape(count, 32))
            yield from ((out + 8 * eight + k, float(v), bool(elsewhere)) for k, v in enumerate(value))


@graphs
@pytest.mark.parametrize("trips", [0, 2])  # 0: all that is formed by several blocks is shared out among them
@pytest.mark.parametrize("blocks", [1, 3, 16])
def test_the_kernels_lists_apply_the_inverse(graph, blocks, trips, monkeypatch):
    monkeypatch.setattr(plans, "TRIPS", trips)
    s = system(graph)
    tree = tree_of(s.pattern)
    sizes = np.unique(tree.size).tolist()
    for groups in range(1, min(4, len(sizes)) + 1):
        thresholds = tuple(sizes[k * len(sizes) // groups] for k in range(1, groups))
        p = lay_out(tree, thresholds, blocks)
        chunks, scale = stored(s.pattern, s.factor, p, np.float64)
        z = applied(DevicePlan(HostGpu, p), chunks, scale, s.r)  # type: ignore[arg-type]
        assert np.linalg.norm(z - s.z) <= 1e-11 * np.linalg.norm(s.z)


@graphs
@pytest.mark.parametrize("blocks", [2, 16])
def test_two_devices_apply_it_with_what_each_writes_into_the_memory_of_the_other(graph, blocks, monkeypatch):
    s = system(graph)
    tree = tree_of(s.pattern)
    sizes = np.unique(tree.size).tolist()
    for groups in range(1, min(4, len(sizes)) + 1):
        monkeypatch.setattr(plans, "TRIPS", groups % 2 * 2)
        thresholds = tuple(sizes[k * len(sizes) // groups] for k in range(1, groups))
        p = lay_out(tree, thresholds, blocks)
        chunks, scale = stored(s.pattern, s.factor, p, np.float64)
        half = blocks // 2
        one, two = (DevicePlan(HostGpu, p, device, half) for device in (0, 1))  # type: ignore[arg-type]
        z = applied_by([(one, 0, half), (two, half, blocks)], chunks, scale, s.r)
        assert np.linalg.norm(z - s.z) <= 1e-11 * np.linalg.norm(s.z)


def test_each_contribution_has_a_reader_on_one_of_two_devices():
    s = system(pattern(1000, bar_edges(9, 9, 9)))
    p = plan(s.pattern, 8, groups=3)
    near, far = NEAR_READS, FAR_READS
    found, flipped = (FarFlags(p, 4, device).contributions() for device in (0, 1))
    assert set(np.unique(found)) <= {near, far, near | far} and len(found) == len(p.slots)
    assert ((found & near > 0) == (flipped & far > 0)).all() and ((found & far > 0) == (flipped & near > 0)).all()
    alone = FarFlags(p, p.blocks, 0)
    assert (alone.contributions() == near).all() and not alone.places().any(), "one device has all thread blocks"


def test_thread_blocks_are_shared_out_by_size():
    few = assign_blocks(np.array([4840, 720, 160]), 124)
    assert few.pooled == 0 and few.blocks.sum() <= 124 and (few.blocks >= 1).all()
    assert few.blocks[0] > few.blocks[1] > few.blocks[2]
    assert few.first.tolist() == [0, few.blocks[0], few.blocks[0] + few.blocks[1]]
    many = assign_blocks(np.r_[np.full(300, 160), 20000], 124)
    assert many.pooled == 300 and many.order[0] == 300 and many.blocks[300] > 8
    assert many.blocks[300] < 124, "some are left for the others"
    alike = assign_blocks(np.full(1024, 720), 248)
    assert alike.pooled == 1024 and (alike.first == -1).all()
    assert assign_blocks(np.full(16, 720), 124).blocks.tolist() == [7] * 16, "an eighth for some would help nobody"
    assert assign_blocks(np.array([4, 4]), 124).blocks.tolist() == [1, 1]


@pytest.mark.parametrize(
    "bodies, blocks, spared", [(1, 1, 8), (16, 1, 4), (64, 1, 4), (256, 2, 4), (1024, 2, 4), (100, 1, 8)]
)
def test_multiprocessors_are_spared_unless_others_would_idle(bodies, blocks, spared):
    nodes = np.full(bodies, 720)
    contributed, grid = best_assignment(nodes, 132, blocks)
    assert grid == blocks * (132 - spared)
    assert busiest(nodes, contributed, grid) <= busiest(nodes, assign_blocks(nodes, blocks * 124), blocks * 124)


@pytest.mark.parametrize("counts", [[1], [3], [7, 2]])
def test_each_thread_block_knows_the_nodes_that_its_rows_read(counts):
    sizes = [216, 120][: len(counts)]
    graphs_ = [GRAPHS["bar"], GRAPHS["two bars"]][: len(counts)]
    offset = np.cumsum([0, *sizes])
    columns = np.concatenate([np.asarray(g[1]) + o for g, o in zip(graphs_, offset, strict=False)])
    starts = [np.asarray(g[0], np.int64) for g in graphs_]
    row_start = np.concatenate([starts[0], *(s[1:] + starts[0][-1] for s in starts[1:])])
    ranges = np.stack([offset[:-1], offset[1:]], axis=1)
    seen = halo(ranges, np.array(counts), row_start, columns)
    rows = 0
    for row_range in seen.ranges:
        low = ranges[row_range["body"], 0]
        nodes = seen.nodes[row_range["halo_first"] :][: row_range["halo"]] + low
        own = low + row_range["begin"] + np.arange(row_range["own"])
        blocks = slice(row_range["block_first"], row_range["block_first"] + row_range["blocks"])
        assert nodes[: row_range["own"]].tolist() == own.tolist() and len(set(nodes.tolist())) == len(nodes)
        assert (nodes[seen.local[blocks]] == columns[blocks]).all()
        rows += row_range["own"]
    assert rows == offset[-1]
    contributed = assign_blocks(np.array(sizes), 12)
    table = initial_ranges(contributed, halo(ranges, contributed.blocks, row_start, columns), 12)
    assert sorted(table[table >= 0].tolist()) == list(range(contributed.blocks.sum()))
