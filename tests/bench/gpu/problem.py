# SPDX-License-Identifier: MIT
"""The beams of the GPU benchmark: 4 x 1 x 1 m, clamped at one end, let go from horizontal.

Linear corotational tetrahedra, Poisson 0.45, 1000 kg/m3, Rayleigh damping of the mass 0.1, dt 30 ms: at 3000 tets this
gives the condition number and the 220 to 240 iterations of plain CG of Courtecuisse et al. 2010, table 4. Homogeneous:
E 1 MPa; heterogeneous: 5 MPa times 1 : 0.05 : 0.01 in three segments, stiffest at the clamp.
"""

from dataclasses import dataclass
from pathlib import Path

BARS = {
    540: (3, 3, 10), 3000: (5, 5, 20), 7350: (7, 7, 25), 24000: (10, 10, 40), 98304: (16, 16, 64),
    405600: (26, 26, 100), 1029000: (35, 35, 140),
}  # fmt: skip
MATERIALS = ("homogeneous", "heterogeneous")
BATCHES = ((1, 3000), (16, 3000), (64, 3000), (256, 3000), (1024, 3000), (512, 540))
VARIANTS = 8  # kinds of beams in a batch: their stiffness differs, so that their iterations do


@dataclass(frozen=True)
class Aim:
    """us per step of a scene: what we set out to reach and what others need. None: not known."""

    aim: float
    prototype: float | None = None  # of this project, before it was one
    paper: float | None = None  # Courtecuisse et al. 2010 on a GTX 480


AIMS = {  # by (beams, tets of each)
    (1, 540): Aim(45, 51, 3320), (1, 3000): Aim(65, 82, 12780), (1, 7350): Aim(95, 131, 41680),
    (1, 24000): Aim(160, 235, 208720), (1, 98304): Aim(550, 765), (1, 405600): Aim(2700, 3050),
    (1, 1029000): Aim(6000, 7073), (256, 3000): Aim(1300, 2140), (512, 540): Aim(500, 690),
}  # fmt: skip


@dataclass(frozen=True)
class Problem:
    """A scene of the benchmark: `beams` beams of `tets` tetrahedra each, of a law."""

    tets: int
    material: str = "homogeneous"
    beams: int = 1
    law: str = "corotational"
    dt: float = 0.03  # s

    @property
    def name(self) -> str:
        """In messages."""
        return f"{self.beams} x {self.tets} tets, {self.material}"

    @property
    def variants(self) -> int:
        """Beams that differ from one another; beam k is like beam k % variants."""
        return min(self.beams, VARIANTS)

    def young(self, beam: int) -> float:
        """Young's modulus at the clamp [Pa]: of a batch's variants, spread by a factor 2 about the usual one."""
        usual = 1e6 if self.material == "homogeneous" else 5e6
        if self.variants < 2:
            return usual
        return usual * 2.0 ** (beam % self.variants / (self.variants - 1) - 0.5)

    def text(self) -> str:
        """The scene in TOML."""
        return "\n".join([f"dt = {self.dt:g}\n{_HEAD}", *(_object(self, beam) for beam in range(self.beams))])

    def write(self, folder: Path) -> Path:
        """The scene as a file in `folder`."""
        path = folder / f"{self.material}-{self.beams}x{self.tets}.toml"
        path.write_text(self.text())
        return path


_HEAD = """
[effects]
gravity = { g = [0, -9.81, 0] }

[solver]
tolerance = 1e-6
max_iterations = 5000
preconditioner = "cholesky"
"""


def _object(problem: Problem, beam: int) -> str:
    cells, young = ", ".join(map(str, BARS[problem.tets])), problem.young(beam)
    if problem.material == "homogeneous":
        stiffness = f"{young:.12g}"
    else:
        ends = ('where = "Z < 1.3333", ', 'where = "Z < 2.6667", ', "")
        parts = (f"{{ {end}young = {f * young:.12g} }}" for end, f in zip(ends, (1, 0.05, 0.01), strict=True))
        stiffness = f"[{', '.join(parts)}]"
    return f"""[[object]]
name = "beam{beam}"
mesh = {{ bar = [{cells}], size = [1, 1, 4], split = "kuhn" }}
elements = "linear"
density = 1000
[object.effects]
{problem.law} = {{ young = {stiffness}, poisson = 0.45 }}
rayleigh = {{ mass = 0.1 }}
fixed = {{ where = "Z < 0.01" }}
"""
