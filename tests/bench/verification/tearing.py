# SPDX-License-Identifier: MIT
"""Damage, in `bench verification`: the work that tears a bar, beside that of its crack."""

from tests.bench.verification.row import Row, relative
from tests.support.tearing import expected, torn

SOURCE = "crack band: Bazant and Oh 1983; exponential softening by the size of the elements"


def damage(quick: bool) -> list[Row]:
    """Work to tear a bar on two meshes."""
    return [
        relative(f"damage: work to tear, {n} cells along", expected(n)[0], torn(n).work, 0.02, SOURCE)
        for n in ((4,) if quick else (4, 8))
    ]
