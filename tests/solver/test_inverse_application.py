# SPDX-License-Identifier: MIT
"""The application of an inverse that checks it: its tiles, phase by phase, beside the triangular solves."""

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from sim_server.backends.gpu.inverse.apply_inverse import phase_tiles
from sim_server.backends.gpu.inverse.plan import plan
from tests.reference.partitioned import COLUMNS, ROWS, STEP, stored
from tests.solver.solves import applied
from tests.worker.block_matrices import bar_edges, pattern, spd


def as_the_kernels_do(p, chunks, scale, r):
    """apply_inverse.cu in NumPy."""
    place = (p.place[:, None] + np.arange(3)).ravel()
    packed, y, contributed = np.zeros(p.size), np.zeros(p.size + COLUMNS), np.zeros(p.contributions + ROWS)
    packed[place] = r
    for phase, tiles in enumerate(phase_tiles(p)):
        if phase < p.groups:
            s = np.zeros(p.size + COLUMNS)
            s[: p.size] = scale[:-1] * packed
            at = np.repeat(np.arange(p.size), np.diff(p.slot_start))
            np.subtract.at(s, at, contributed[p.slots])
        to = contributed if phase < p.groups - 1 else y
        for tile in tiles:
            start, chunk, count = int(tile["start"]), int(tile["chunk"]), int(tile["chunks"])
            outside = p.boundary[int(tile["boundary"]) :][: COLUMNS * (count - int(tile["inside"]))]
            x = np.append(s[start : start + COLUMNS * int(tile["inside"])], y[outside]).reshape(count, COLUMNS)
            matrix = chunks[chunk : chunk + count].astype(float)
            if p.planes == 2:
                matrix = matrix + chunks[chunk + count : chunk + 2 * count].astype(float) / STEP
            to[tile["out"] : tile["out"] + ROWS] = np.einsum("crk,ck->r", matrix, x)
    return (scale[:-1] * y[: p.size])[place]


@pytest.mark.parametrize(("planes", "bound"), [(1, 2.0**-9), (2, 1e-5)])
@pytest.mark.parametrize("groups", [1, 2, 4])
def test_tiles_phase_by_phase_apply_the_factor(groups, planes, bound):
    cells = (3, 3, 10)
    nodes = int(np.prod(np.add(cells, 1)))
    graph = pattern(nodes, bar_edges(*cells), np.arange((cells[0] + 1) * (cells[1] + 1)))
    analysis = Analysis(*graph)
    values = analysis.factorize(spd(*graph, seed=1), np.float32)
    p = plan(analysis.pattern, 132, groups, planes)
    chunks, scale = stored(analysis.pattern, values, p, np.float16)
    r = np.random.default_rng(0).normal(size=analysis.pattern.size)
    z, expected = as_the_kernels_do(p, chunks, scale, r), applied(analysis.pattern, values)(r)
    assert np.linalg.norm(z - expected) <= bound * np.linalg.norm(expected)
