# SPDX-License-Identifier: MIT
"""The lowest twenty natural frequencies of a block, by kind of elements, beside a finer mesh: no motion is spurious."""

from functools import cache

import numpy as np
import pytest
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import eigsh

from sim_server.mesh import Mesh
from sim_server.simulation import Simulation
from tests.scenes import bar, jittered_bar, scene

SIZE, YOUNG, COUNT = (1.0, 1.2, 1.5), 1e6, 20  # m; Pa
FREE, CLAMPED = None, "Z < 1e-6"
TOLERANCE = {  # by kind: cells a side, the lowest and the highest part of a frequency that may be found
    "patch": (5, 0.95, 1.15), "smoothed": (5, 0.8, 1.02), "quadratic": (2, 0.87, 1.02),
}  # fmt: skip


@cache
def frequencies(kind: str, cells: int, poisson: float, fixed: str | None) -> NDArray[np.float64]:
    """[Hz], and of a free body six more, of rigid motions, by the matrix of a step at rest and the lumped masses."""
    mesh = Mesh(*jittered_bar((cells,) * 3, SIZE, seed=1))
    made = scene(bar(poisson=poisson, young=YOUNG, elements=kind, fixed=fixed), dt=1.0)
    made.objects[0].use_mesh(mesh.with_mid_nodes() if kind == "quadratic" else mesh)
    sim = Simulation(made)
    sim.engine.assemble()
    w = sim.world
    free = np.flatnonzero(np.repeat(w.free, 3))
    mass = sp.diags_array(np.repeat(w.mass, 3)[free])
    K = (sp.csc_array(sim.matrix())[free][:, free] - mass) / (w.force_coefficient * w.dx_dv)
    rigid = 0 if fixed else 6
    squares = eigsh(K, COUNT + rigid, mass.tocsc(), sigma=0.0 if fixed else -1e3, return_eigenvectors=False)
    return np.sqrt(np.abs(np.sort(squares))) / (2 * np.pi)


@pytest.mark.parametrize("kind", TOLERANCE)
@pytest.mark.parametrize("poisson", [0.3, 0.499])
@pytest.mark.parametrize("fixed", [FREE, CLAMPED], ids=["free", "clamped"])
def test_each_of_the_lowest_frequencies_is_that_of_a_fine_mesh(kind, poisson, fixed):
    """A motion that resists too little would stand among them and put all behind it out of place."""
    cells, least, most = TOLERANCE[kind]
    found, exact = frequencies(kind, cells, poisson, fixed), frequencies("quadratic", 4, poisson, fixed)
    rigid = 0 if fixed else 6
    assert (found[:rigid] < 1e-4 * exact[rigid]).all()
    ratio = found[rigid:] / exact[rigid:]
    assert least < ratio.min() and ratio.max() < most, ratio.round(3)


def test_smoothed_ones_come_nearer_on_finer_meshes():
    """Mostly by their lumped masses; those of patches are near at once, those of linear elements far off."""
    exact = frequencies("quadratic", 4, 0.499, CLAMPED)

    def error(kind: str, cells: int) -> float:
        return float(np.abs(frequencies(kind, cells, 0.499, CLAMPED) / exact - 1).mean())

    assert error("smoothed", 7) < 0.5 * error("smoothed", 4) < 0.1
    assert error("patch", 7) < 0.06
    assert error("linear", 7) > 0.3
