# SPDX-License-Identifier: MIT
"""What the page of hard cases says beside its tables."""

ABOUT = """\
What breaks simulators of deformable bodies, each case with several seeds: what must hold, of how many seeds it holds on
each device and in each precision, and what was measured. Each row is a run of the tables in tests/hard_cases, which
tests assert; this page is made by the same code, and what does not hold stands on it. What a run does when things go
wrong is one table, too: [When things go wrong](../failures.md). A film of ten that hold is in the
[gallery](../gallery.md#hard-cases), and one of all that are known to fail.

*n of m*: of m seeds n hold all of what must hold. In mixed and single precision (GPU) solves may end at rounding, the
energy may rise by rounding (1e-4 and 1e-3 of what is dissipated), and positions are compared to 1e-3 of the length."""
RECIPES = """\
## All of it

The classic list, with all cases, seeds and models of each entry; *and*: tests of what is no run of a scene."""
FAILURES = """\
## What does not hold, and why

*known*: stated as such in the tables (then tests hold that it fails as said, and that the statuses tell)."""
REFUSALS = """\
Refused by their reason:"""
TIMES = """\
## Wall time

Of each run of the bench that this page is made of, with start of processes and compilation; *sum of the cases*: of
their own wall times, in processes beside each other; *load*: of the machine by other work, at the start."""
CASES = """\
## One bar, one law

A bar of 1 x 1 x 4 m (648 tetrahedra, E = 1 MPa, Poisson's ratio 0.45, dt = 0.02 s, tolerance 1e-6, factor by
lockstep-10 with warp) is driven where no run should get by itself. Seeds beyond the first have gravity turned about the
bar, and noise: 1e-2 L/s in the velocities, 1e-10 L in the positions.

- *must hold*: what is asserted. J is det F of an element, L the length of the bar.
- *energy*: largest rise of kinetic + potential energy - work of the loads over its lowest earlier value, as a part of
  what the run dissipates. It never rises but where a note says why; there, *at dt / 10* is the rise (as a part of the
  same) when the first 150 steps are made with a tenth of the time step.
- *status*: of all solves of all seeds; *converged* means the true residual, in every step, *residual* the largest of
  these. *cost*: time and iterations of all steps over those of the same bar made easy (ordinary material and step,
  hanging under gravity; a bar that spins: at 1 rad/s), of seed 0, step by step beside each other in one process.
  *V / V0*: volume over that at rest, smallest and largest. *smallest J*: after the first step.
- *back*: step from which every node stays within the distance that must hold; *straight*: of bars with several
  equilibria, how many seeds ended in the shape at rest; *at the end / L*: distance there; where
  every step is compared, the largest."""
EFFECTS = """\
## Effects, contact, cuts, loads

Each seed has other masses, places or strengths (tests/hard_cases/effect_table.py, recipe_table.py). Numbers are finite,
steps are solved or say how they ended, and the figure of *must hold* is at most what stands there; *worst*: of all
seeds; *cost*: over the same scene made easy, or without what is done to it."""
MODELS = """\
## The deformation models

A bar of 1 x 1 x 4 m (192 tetrahedra, constants of about E = 1 MPa and Poisson's ratio 0.45, the rest as above) of each
model, in situations that are hard for one or the other (tests/hard_cases/models.py; some of them are tests). *Newton*:
with `[integrator] linearizations = 20`, which makes several linearizations a step with a line search; all others make
one, the default. *clamp*: with `[solver] projection = "clamp"`, what fails so and holds by default. *patch*, *smoothed*
and *quadratic* are kinds of `elements`. What is known not to hold is stated as such and shown: **no**.
"""
MATRIX = """\
*yes*: all of what must hold; *rises*: all of it, where the energy may rise; *refused*: by its name."""
STARTS = """\
## Random starts

The bar of 648 tetrahedra, split in two ways, every free node anywhere in the bounding box: how many of the seeds
end how after 14 s (Rayleigh damping 1/s; tests/hard_cases/seeds.py). *back at rest*: within 0.001 L; *elsewhere,
J > 0*: no element inverted, but folded through itself (there is no contact), or still in motion; *flown apart*: not
finite or ten lengths away. What follows a comma is Poisson's ratio, 0.45 elsewhere, `[solver] projection`, or the kind
of elements, linear elsewhere. *corotational* stays inside out where that is an equilibrium: lambda sees the sum of the
stretches alone, which an element turned inside out may have, too (effects/corotational.py).
"""
LONG = """\
## Long runs

A bar of four cells (tests/hard_cases/long_runs.py). *memory*: of the process, grown since a tenth of the run. *cost*:
processor time of a step in the last tenth over that in the second.
"""
EXTREMES = """\
## What workers and clients may do at worst

No runs of the tables below, but tests: the answer stays the same, or the message is refused by its reason."""
EXTREME_ROWS = [
    dict(zip(("what", "what happens", "tests"), row, strict=True))
    for row in (
        (
            "a factor 1, 10, 100 or 1000 steps old",
            "the same answer, more iterations",
            "`tests/hard_cases/test_extremes.py`, *old factor* below",
        ),
        (
            "a factor of another object",
            "the same answer",
            "`tests/hard_cases/test_extremes.py`",
        ),
        (
            "a factor of -A",
            "its pivots are turned: the same answer",
            "`tests/hard_cases/test_extremes.py`",
        ),
        (
            "a factor with one NaN, of half the size, of another epoch, of another job; bytes that are none",
            "refused; the job ends, the last factor stays",
            "`tests/system/test_hostile_answers.py`",
        ),
        (
            "workers that are killed, stopped, slow; none ever",
            "the last factor, or block Jacobi",
            "`tests/faults/test_faults.py`, *no worker* below",
        ),
        (
            "a push of 1e6 N; a force that is no number",
            "refused: `max_force`, finite",
            "`tests/hard_cases/test_extremes.py`",
        ),
        (
            "a grab of 1e6 N",
            "exerts what the object allows",
            "`tests/hard_cases/test_extremes.py`",
        ),
        (
            "a grab of a node without elements",
            "refused: no free node",
            "`tests/hard_cases/test_extremes.py`",
        ),
        (
            "a parameter that jumps by 1e6",
            "taken, and counted as work",
            "*a stiffness that jumps by 1e6* below",
        ),
        (
            "another `dt` while steps run",
            "refused: it is of a new run",
            "`tests/hard_cases/test_extremes.py`",
        ),
        (
            "scenes, states and events at random",
            "no error but those for users, finite numbers, true statuses, the same bits twice",
            "`tests/hard_cases/test_random_scenes.py`",
        ),
    )
]
