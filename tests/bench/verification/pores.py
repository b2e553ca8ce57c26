# SPDX-License-Identifier: MIT
"""Consolidation of a column of soil, in `bench verification`, beside Terzaghi's series."""

from tests.bench.verification.row import Row, absolute, relative
from tests.support.consolidation import LOAD, STORAGE, YOUNG, column, consolidation, settlement


def poroelasticity(quick: bool) -> list[Row]:
    """Settlement at once, and as the fluid leaves."""
    source = "Terzaghi, Theoretical Soil Mechanics, 1943"
    cells, steps = (10, 400) if quick else (40, 8000)
    sim, first, last = column(cells, steps), LOAD / (YOUNG + STORAGE), LOAD / YOUNG
    sim.engine.run(1)
    rows = [relative("poroelasticity: settlement at once", first, settlement(sim), 1e-3, source)]
    done = 1
    for time in (0.1, 0.3, 1.0):
        sim.engine.run(round(time * steps) - done)
        done = round(time * steps)
        degree, exact = (settlement(sim) - first) / (last - first), consolidation(time)
        rows.append(
            absolute(f"poroelasticity: part of it at time {time}", exact, degree, 0.05 if quick else 0.02, source)
        )
    return rows
