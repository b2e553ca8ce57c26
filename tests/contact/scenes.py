# SPDX-License-Identifier: MIT
"""Scenes of contact for tests of both devices."""

from collections.abc import Sequence
from pathlib import Path

BLOCK = """
[[object]]
name = "block"
mesh = {{ bar = {bar}, size = [0.1, 0.06, 0.1] }}
pose = {{ translate = [0, {height}, 0] }}
density = 1000.0
friction = {friction}
effects = {{ corotational = {{ young = 3e5, poisson = 0.45 }} }}
"""
FLOOR = """
[[obstacle]]
name = "floor"
shape = "plane"
friction = 0.5
"""
RAM = """
[[obstacle]]
name = "ram"
shape = "box"
size = [0.3, 0.02, 0.3]
keyframes = [
    { time = 0, translate = [0, -0.3, 0] }, { time = 0.04, translate = [0, 0.1, 0] },
    { time = 1, translate = [0, 0.1, 0], rotate = [0, 0, 20] },
]
"""  # at 10 m/s


def block_on(
    folder: Path, obstacles: Sequence[str] = (FLOOR,), bar: str = "[3, 2, 3]", height: float = 0.02, friction: float = 0.5,
    gravity: str = "[0, -9.81, 0]", solver: str = 'preconditioner = "block_jacobi"', contact: str = "{}",
) -> Path:  # fmt: skip
    """Writes a scene of a block, 0.1 x 0.06 x 0.1 m, whose lower side is at `height` [m]; returns its file."""
    path = folder / "block.toml"
    path.write_text(
        f"dt = 0.016666666666666666\n[effects]\ngravity = {{ g = {gravity} }}\ncontact = {contact}\n[solver]\n{solver}\n"
        + BLOCK.format(bar=bar, height=height, friction=friction)
        + "".join(obstacles)
    )
    return path
