# SPDX-License-Identifier: MIT
"""A scene of many bodies drawn from a seed: the same seed gives the same bytes."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator

DT = 0.02  # s
DENSITY = 1000.0  # kg/m3
YOUNG = (1e6, 1e7)  # Pa, equally likely on every scale
POISSON = (0.3, 0.45)
FORCE = (0.01, 0.5)  # largest force on a body over its weight, equally likely on every scale
SPACING = 5.0  # m between neighbours of the grid
FRAME_INTERVAL = 50  # steps between frames of the log; a load test reads scalars only

HEAD = """\
# {objects} bodies of {low} to {high} tetrahedra, drawn from seed {seed} by `sim-client load`.
dt = {dt}
[effects]
gravity = {{ g = [0, -9.81, 0] }}
[record]
every = {every}
"""

BODY = """
[[object]]
name = "{name}"
mesh = {{ bar = [{a}, {a}, {b}], size = [1, 1, {length:.4f}] }}
pose = {{ rotate = [0, {turn:.1f}, 0], translate = [{x:g}, 0, {z:g}] }}
elements = "linear"
density = {density:g}
[object.effects]
corotational = {{ young = {young:.4g}, poisson = {poisson:.3f} }}
rayleigh = {{ mass = 0.1, stiffness = 0.01 }}
fixed = {{ where = "Z < 0.01" }}
touch = {{ max_force = {force:.4g}, max_interactions = 256 }}
"""


def scene_text(objects: int, tets: tuple[int, int], seed: int) -> str:
    """Writes the TOML of bars on a grid, held at one end, with random sizes, materials and largest forces."""
    draw = random.Random(seed)
    low, high = tets
    head = HEAD.format(objects=objects, low=low, high=high, seed=seed, dt=DT, every=FRAME_INTERVAL)
    return head + "".join(_bodies(objects, low, high, draw))


def _bodies(objects: int, low: int, high: int, draw: random.Random) -> Iterator[str]:
    side, digits = math.ceil(math.sqrt(objects)), len(str(objects - 1))
    for number in range(objects):
        a, b = cells(_log_uniform(draw, low, high))
        weight = DENSITY * (b / a) * 9.81
        yield BODY.format(
            name=f"bar{number:0{digits}}", a=a, b=b, length=b / a, turn=draw.uniform(-30, 30),
            x=SPACING * (number % side), z=2 * SPACING * (number // side), density=DENSITY,
            young=_log_uniform(draw, *YOUNG), poisson=draw.uniform(*POISSON),
            force=weight * _log_uniform(draw, *FORCE),
        )  # fmt: skip


def cells(tets: float) -> tuple[int, int]:
    """Returns a, b of a bar of (a, a, b) cells with about `tets` tetrahedra, six a cell; b is about 4 a."""
    a = max(1, round((tets / 24) ** (1 / 3)))
    return a, max(1, round(tets / (6 * a * a)))


def _log_uniform(draw: random.Random, low: float, high: float) -> float:
    return math.exp(draw.uniform(math.log(low), math.log(high)))
