# SPDX-License-Identifier: MIT
"""Both measurements of one effect, which may be made in a process of its own."""

from pathlib import Path

from tests.bench.effects.absence import absence
from tests.bench.effects.cost import Row, cost
from tests.support.effect_samples import Cells


def measured(cells: Cells, rounds: int, starts: int, folder: Path, name: str) -> tuple[Row, Row]:
    """Returns what an effect costs, and what it costs where it is not listed. folder: with the copy `whole`"""
    own = folder / name
    own.mkdir()
    return cost(name, cells, rounds, own), absence(name, cells, 2 * rounds, starts, folder / "whole", own)
