# SPDX-License-Identifier: MIT
"""THE TABLE of hard cases: name, scene, what is done, what must hold (measured numbers: docs/bench/hard_cases.md)."""

from tests.hard_cases import sources, starts
from tests.hard_cases.case import FREE_BAR, GRAVITY, Case, Hold, young
from tests.hard_cases.slivers import sliver_bar

TANGENT = (
    "A step is one linearization with the rotations of its beginning and moves nodes along tangents: elements that "
    "turn by an angle a in one step are stretched by up to sqrt(1 + a²), which no load has paid for. It is an error of "
    "the time step: with a tenth of it the rise is less than half as large."
)
NO_FACTOR_YET = "The first ten steps have no factor yet, and block Jacobi alone may not be enough."

SEVERAL = (
    "Without contact with itself the bar has several stable equilibria (tests/hard_cases/test_equilibria.py), and "
    "noise decides to which it comes: straight, or folded through itself. Some have elements inside out, which this "
    "law may keep so (as of random starts at Poisson's ratio 0.45, below): then the last of what must hold does not."
)

JUMPS = (
    " Rotations of elements that turn back jump: in one of five seeds energy rises by 1.5e-5 of what is dissipated, "
    "and not at all with half the time step."
)

MATERIAL = [
    Case("stiffness 1 : 1e-3 : 1e-6", "bands along Z, stiffest at the held end; hangs under gravity",
         (GRAVITY, young(("Z < 1.3", 1e11), ("Z < 2.7", 1e8), ("true", 1e5))), rests="static", steps=600,
         recovered=500, iterations=10),
    Case("stiffness 1e6 side by side", "stiff and soft halves along X bend together under gravity",
         (GRAVITY, young(("X < 0.5", 1e10), ("true", 1e4))), rests="static", recovered=380, iterations=10),
    Case("Poisson 0.499", "hangs under gravity", (GRAVITY, "object.bar.effects.corotational.poisson=0.499"),
         rests="static", recovered=300, iterations=25, unconverged={"max_iterations": 10},
         note="Linear tetrahedra lock: it bends a fifth as far as with 0.45. " + NO_FACTOR_YET),
    Case("Poisson 0.4999", "hangs under gravity", (GRAVITY, "object.bar.effects.corotational.poisson=0.4999"),
         rests="static", recovered=300, iterations=60, unconverged={"max_iterations": 10},
         note="Linear tetrahedra lock: it bends a fifth as far as with 0.45. " + NO_FACTOR_YET),
    Case("slivers", "one layer a thousandth as thick: aspect 1e3, dihedral angles < 1°; hangs under gravity",
         (GRAVITY,), build=sliver_bar, rests="static", recovered=380, iterations=15,
         unconverged={"max_iterations": 10}, note=NO_FACTOR_YET),
    Case("mass ratio 1e4", "the held half 1e-4 times as heavy; hangs under gravity", (GRAVITY,),
         start=starts.mass_times(1e-4, below=2), rests="static", steps=600, recovered=500, iterations=10),
]  # fmt: skip

STARTS = [
    Case("inside out, X", "mirrored at its middle plane, J = -1 everywhere", start=starts.mirrored(0), steps=800,
         rests="still", recovered=700, several=True, note=SEVERAL),
    Case("inside out, Z", "mirrored along its length, but for the held end", start=starts.mirrored(2), steps=800,
         recovered=700),
    Case("inside out, symmetric mesh", "as before on a mesh that is its own mirror image",
         ('object.bar.mesh={ bar = [4, 4, 12], size = [1, 1, 4], split = "mirrored" }',), start=starts.mirrored(0),
         steps=800, rests="still", recovered=700, energy=1e-4, several=True, note=SEVERAL + JUMPS),
    Case("swapped layers", "layers of nodes change places in pairs", start=starts.swapped_layers, steps=800,
         recovered=700),
    Case("flat", "all nodes in the plane Y = 0.5 m, noise 1 um", start=starts.flattened(1), steps=800,
         recovered=700),
    Case("a line", "all nodes on a line, noise 1 um", start=starts.flattened(0, 1), steps=800,
         rests="still", recovered=700, several=True, note=SEVERAL),
    Case("a point", "all free nodes in one point, noise 1 um", start=starts.flattened(0, 1, 2), steps=800,
         recovered=700),
    Case("random", "all free nodes anywhere in the bounding box, one seed (below: many)", start=starts.random_in_box,
         steps=800, recovered=700),
    Case("stretched 3 times", "released from 12 m", start=starts.stretched(3), steps=800,
         recovered=700),
    Case("stretched 10 times", "released from 40 m", start=starts.stretched(10), steps=1600, recovered=1400,
         energy=1, note=TANGENT),
]  # fmt: skip

MOTION = [
    Case("time step × 10", "dt = 0.2 s; hangs under gravity", (GRAVITY, "dt=0.2"), rests="static", recovered=100),
    Case("newmark", "Newmark's scheme, one linearization; hangs under gravity", (GRAVITY, "integrator.scheme=newmark"),
         rests="static", recovered=300, energy=1e-9),
    Case("bdf2", "BDF2, one linearization; hangs under gravity", (GRAVITY, "integrator.scheme=bdf2"), rests="static",
         recovered=300, energy=1e-9),
    Case("ros2, an end 1e3 times as stiff", "the free end stiff as bone; thrown sideways at 30 m/s",
         (young(("Z > 3", 1e9), ("true", 1e6)), "integrator.scheme=ros2"), start=starts.thrown(30), steps=600,
         recovered=500, energy=5, note=TANGENT),
    Case("time step × 50", "dt = 1 s; hangs under gravity", (GRAVITY, "dt=1.0"), rests="static", recovered=100,
         energy=12, note=TANGENT),
]  # fmt: skip

FACTORS = [
    Case("no worker", "update = async and nobody ever factorizes", (GRAVITY, "solver.update=async"),
         source=sources.nobody, rests="same", within=1e-6),
    Case("old factor", "made at rest, used until it is 1000 steps old", (GRAVITY, "solver.update=never"), steps=1001,
         rests="same", within=1e-6, iterations=10),
    *(
        Case(f"poisoned: {name}", done, (GRAVITY,), source=sources.poisoned(poison), rests="same", within=1e-6,
             steps=200, note=note)
        for name, poison, done, note in (
            ("negated", lambda v: -v, "-L for L", "Harmless: (-L)(-L)^T = L L^T."),
            ("noise", sources.noisy, "entries of L changed by up to ± 50 %", ""),
            ("shuffled", sources.shuffled, "entries of L in random places", ""),
            ("ones", sources.ones, "1 for every entry of L", "Left after half the iterations allowed, in each solve."),
            ("NaN", sources.one_nan, "one entry NaN, let past the link", "The link refuses such a factor before."),
            ("overflow", sources.overflowing, "L × 1e-36, so that P^-1 r overflows in float32", ""),
        )
    ),
]  # fmt: skip

LOADS = [
    Case("violent push", "1e6 N (25 times its weight) on the free end for 0.5 s, then let go",
         hold=Hold(25, (0.5, 0.5, 4), 0.8, force=(0, 1e6, 0)), steps=800, recovered=500, energy=0.1,
         note=TANGENT),
    Case("violent push on one node", "1e6 N on a corner for 0.5 s, then let go",
         hold=Hold(25, (1, 1, 4), 0, force=(0, 1e6, 0)), steps=800, recovered=500, energy=2, note=TANGENT),
    Case("torn by a grab", "the free end grabbed at 1e9 N/m and pulled to 40 m, at most 1e6 N, for 0.5 s",
         hold=Hold(25, (0.5, 0.5, 4), 0.8, target=(0.5, 0.5, 40), stiffness=1e9, limit=1e6), steps=800,
         recovered=500),
]  # fmt: skip

SPINS = [
    Case(f"spin {speed} rad/s", f"free, turning about X: {speed * 0.02:g} rad a step",
         file=FREE_BAR, start=starts.spinning(speed), steps=300, rests="spin", energy=energy, note=TANGENT,
         easy=(), easy_start=starts.spinning(1))
    for speed, energy in ((10, 0.2), (100, 3), (1000, 10))
]  # fmt: skip

CASES = [*MATERIAL, *STARTS, *MOTION, *SPINS, *LOADS, *FACTORS]
