# SPDX-License-Identifier: MIT
"""Bars that end folded, in hard cases with several equilibria, are in stable ones of their law: no step was wrong."""

from pathlib import Path

import numpy as np
import pytest

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.hard_cases.running import Place, Reals, built
from tests.hard_cases.table import CASES
from tests.support.single_steps import SingleSteps

FOLDED = np.load(Path(__file__).with_name("equilibria.npz"))
"""Positions in which seeds of cases came to rest, (nodes, 3) each, by `CASE, seed`."""


def bar_of(case: str, folder: Path) -> Simulation:
    """The bar of a case, in its pose."""
    return built(next(each for each in CASES if each.name == case), Place(folder))


def stiffness(sim: Simulation) -> tuple[Reals, Reals]:
    """-df/dx of the free nodes by central differences [N/m], and f [N]."""
    w, steps = sim.world, SingleSteps(sim, "double")
    free, at = np.repeat(w.free > 0, 3), w.x.ravel().copy()
    w.v[:] = 0

    def force(x: Reals) -> Reals:
        w.x.ravel()[:] = x
        steps.assemble("nodes.rotate")
        return np.asarray(sim.system.b.ravel()[free] / w.dt)

    columns = []
    for place in np.flatnonzero(free):
        move = 1e-6 * (np.arange(len(at)) == place)
        columns.append((force(at - move) - force(at + move)) / 2e-6)
    return np.array(columns).T, force(at)


def lowest(matrix: Reals) -> float:
    """Smallest eigenvalue."""
    assert np.abs(matrix - matrix.T).max() < 1e-6 * np.abs(matrix).max()
    return float(np.linalg.eigvalsh((matrix + matrix.T) / 2)[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", FOLDED.files)
def test_a_folded_bar_is_in_a_stable_equilibrium(name: str, tmp_path: Path) -> None:
    case = name.rsplit(", ", 1)[0]
    folded, straight = bar_of(case, tmp_path), bar_of(case, tmp_path)
    folded.world.x[:] = FOLDED[name]
    Driver(folded).advance(200)
    assert np.abs(folded.world.x - FOLDED[name]).max() < 1e-6
    assert np.abs(folded.world.x - straight.world.x).max() > 0.1
    matrix, force = stiffness(folded)
    assert np.abs(force).max() < 1e-9 * np.abs(matrix).max()
    assert lowest(matrix) > 0.05 * lowest(stiffness(straight)[0])
