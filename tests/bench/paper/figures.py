# SPDX-License-Identifier: MIT
"""What Courtecuisse et al. 2010 print in their tables 1, 2 and 5, to be shown beside what we measure.

Their machine: Core i7 at 3.07 GHz with four cores, GTX 480. Where they iterate until is nowhere stated.
"""

from typing import NamedTuple


class Size(NamedTuple):
    """A row of table 1: ms to factorize, CG iterations, ms per step, steps to factorize."""

    factorize: float
    iterations: float
    step: float
    steps: float


class Cell(NamedTuple):
    """Of table 2: mean iterations, ms per step."""

    iterations: float
    ms: float


class Cost(NamedTuple):
    """A row of table 5: iterations, ms of the preconditioner's making, of the solve, of both. None: not given."""

    iterations: float
    invert: float | None
    solve: float
    total: float


TABLE1 = {  # by tetrahedra
    540: Size(5.84, 4.40, 3.32, 1.76),
    3000: Size(38.47, 5.01, 12.78, 3.01),
    7350: Size(125.9, 5.56, 41.68, 3.02),
    24000: Size(730.5, 6.09, 208.72, 3.50),
}

# By load (its place in the table) and model: without preconditioner, precomputed, precomputed and warped, asynchronous,
# asynchronous and warped.
SCHEMES = ("none", "precomputed", "precomputed + warp", "async", "async + warp")
_TABLE2 = {
    (0, "corotational"): ((257.44, 110.97), (14.23, 23.45), (10.94, 19.70), (6.91, 12.72), (5.61, 11.27)),
    (0, "MJED"): ((117.36, 13.74), (12.24, 16.33), (13.99, 20.41), (4.51, 6.97), (4.73, 8.10)),
    (0, "springs"): ((56.28, 8.34), (13.46, 18.82), (16.03, 23.94), (7.72, 14.24), (8.14, 15.90)),
    (1, "corotational"): ((252.63, 107.40), (20.99, 34.30), (6.90, 12.57), (13.58, 23.02), (6.51, 12.83)),
    (1, "MJED"): ((179.28, 20.03), (13.52, 17.86), (8.77, 13.19), (9.52, 12.98), (6.62, 11.24)),
    (1, "springs"): ((82.55, 11.72), (16.81, 23.31), (9.51, 14.56), (11.82, 19.89), (8.65, 17.00)),
    (2, "corotational"): ((264.20, 119.39), (93.20, 154.63), (15.54, 27.83), (20.70, 35.19), (6.87, 13.76)),
    (2, "MJED"): ((119.61, 16.32), (35.87, 47.94), (28.23, 40.44), (10.33, 14.35), (8.78, 13.82)),
    (2, "springs"): ((51.28, 8.54), (44.29, 62.85), (19.61, 29.68), (11.72, 18.59), (7.71, 14.30)),
}
TABLE2 = {
    (load, model, scheme): Cell(*cell)
    for (load, model), cells in _TABLE2.items()
    for scheme, cell in zip(SCHEMES, cells, strict=True)
}
CONDITION = 1246.0  # of the beams of table 2

TABLE5 = {  # by way of updating and preconditioner
    ("standard", "none"): Cost(654.03, None, 126.44, 126.44),
    ("standard", "jacobi"): Cost(356.96, 0.15, 86.42, 86.58),
    ("standard", "ssor"): Cost(116.72, 30.60, 55.61, 86.21),
    ("standard", "cholesky"): Cost(1.00, 39.27, 3.13, 42.40),
    ("standard", "incomplete_cholesky"): Cost(6.07, 107.24, 7.29, 114.54),
    ("async + warp", "jacobi"): Cost(357.99, 0.16, 93.18, 93.34),
    ("async + warp", "ssor"): Cost(116.76, 0.26, 62.70, 62.97),
    ("async + warp", "cholesky"): Cost(6.02, 0.06, 11.92, 11.98),
    ("async + warp", "incomplete_cholesky"): Cost(8.71, 0.03, 10.76, 10.79),
}
HETEROGENEOUS = 10317.0  # condition number of the beam of table 5
