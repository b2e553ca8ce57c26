# SPDX-License-Identifier: MIT
"""What the page of bench rosenbrock says. Figures stand in its tables."""

SETUP = """\
`[integrator] scheme = "ros2"` makes a step of second order by two stages with one matrix. *Iterate*: that of the
step, assembled and solved with conjugate gradients; *factor*: the warped factor of an older one in its place,
without assembly and iterations ([how](../scenes.md#a-step-without-iterations)). Here both stand beside the other
schemes.

A bar of 1 x 1 x 4 m (L = 4 m), 1000 kg/m3, held at one end, cells split as `mirrored`, linear corotational
tetrahedra with the tangent that each scheme has by default, E = 1 MPa, Poisson's ratio 0.45, damping of the mass
0.1/s, let go from horizontal, where nothing else is said. *bands*: 5 E, E / 4 and E / 20 in three parts of equal
length, stiffest at the held end. Factors are made by `lockstep-D`, which repeats exactly: the first of the first
matrix, the next ones D to 2 D - 1 steps old when used, by default with D = 10 for all schemes. They are made
outside of the steps and not counted, and are the same work for all schemes with the same D. Their values are
float32 on a CPU and float16 on a GPU, where nothing else is said."""

PRECISION = """\
Error: root mean square of the distances of all nodes from where they are in the reference, over all frames of the
run (each 40 ms), over L. The reference is `newmark` with Newton to 1e-10 at a time step of 1.25 ms on the same
mesh, so mesh and model are the same on both sides; a second reference is `ros2`, by iterations to 1e-8, at 2.5 ms.
Behind the names of the methods: tolerance of the linear solves; *n linearizations*: at most, with a line search.
The time is that of the loop alone. Larger bars are measured with fewer methods, without those that small ones show
to be beaten by their likes."""

SUMMARY = """\
Time of the cheapest other scheme (none of `ros2`) for an error over that of `ros2` by a factor 10 to 19 steps old
for the same error: above 1 `ros2` is cheaper. Columns: error / L. There is no number where one of the two does not
get there with the time steps measured (those under *All points*; larger ones, which may be cheaper for a large
error, were not tried), or where the error is below three times the distance of the two references."""

POINTS = "Error / L and milliseconds a simulated second of each time step. *apart*: not finite, or it ran away."

TIMES = """\
Time steps of 20 ms, factors 10 to 19 steps old. Each tenth step copies a matrix for the next factor, for which a
step by the factor alone assembles it, too: that is its p99; p50 is a step without. *assemble*, *solve*,
*integrate*: what a step without a copy is made of, medians; in `ros2` by the factor *assemble* is the forces and
rotations of the first stage, *solve* the two applications of the factor, and the forces of the second stage are the
rest."""

AGES = """\
4 s of motion of 540 tetrahedra. Factor D to 2 D - 1 steps old, *age at least*: D; before the first of these it is
that of the first matrix. Beside it backward Euler and the iterating form of `ros2`, with factors 10 to 19 steps
old. *Not warped*: the factor is applied in the world frame, as its matrix was. The estimate is that of a step, not
of the run: the largest of a node."""

STABILITY = """\
540 tetrahedra, 8 s, damping of the mass 1/s, so that what holds comes to rest; all starts but *let go* without
gravity. One or two things are varied at a time around a base case (E = 1 MPa, Poisson's ratio 0.45, corotational,
20 ms, factors 10 to 19 steps old). Left out: all other combinations, other models than these four, more than one
body, grabs."""

STABILITY_COLUMNS = """\
*latency*: D of the factor's age, D to 2 D - 1 steps. *holds*: finite, never ran away, and at the end (the last
twentieth) less than a hundredth of the largest kinetic energy of the run is left. *energy*: kinetic + potential at
the end over the start. *inverted*: elements with J <= 0 at the end. *factor*, *iterate*, *euler*: shares of the
steps by their form. *apart*: root mean square of the distances from backward Euler's end / L. *Euler*: the same of
backward Euler, with factors 10 to 19 steps old."""

UNDAMPED = """\
The beam without damping, 30 s, 540 tetrahedra: mean kinetic energy of the last quarter of the time over that of the
first (1 if none were lost, but for where in its swing the beam is), and what kinetic and potential energy together
have changed by, over the largest kinetic energy of the run: below 0 a loss."""

FREE = """\
A bar of 540 tetrahedra that nothing holds and no gravity acts on, 20 s: it moves off, tumbles at about 2 rad/s and
vibrates along. *linear*, *angular*: largest change of the momentum (angular: about the origin) in the run over the
momentum at the start. *energy at the end*: kinetic and potential over that at the start: of the vibration, which may
die away, and of the spin, which should not. *Newton*: up to ten linearizations a step."""

LIMITS = """\
*Not with time steps too large for the motion.* The estimate then exceeds the bound (a tenth of the shortest edge)
and the step is made again by iterations, and again by backward Euler: up to three attempts for one step, no more
exact than backward Euler and dearer. A larger bound does not help: without one these runs fly apart.

*Not for violence.* The same: it holds, since it becomes backward Euler, but costs more than backward Euler alone
while it lasts.

*Not for nearly incompressible bodies at large time steps.* Their errors are larger than those of backward Euler.
With the usual tangent of `corotational` one that turns fast goes on to vibrate, fed by the step and held down by
backward Euler alone (the last table of stability); the exact one, the default here, ends that, and costs a step by
the factor nothing, as it assembles nothing, but where the stiffness damps.

*Not with much damping of the stiffness.* There backward Euler is more exact than either form.

*Little for small bodies.* Conjugate gradients need few iterations there, and a step by the factor evaluates forces
twice.

Base case and what is varied, 2 s, factors 10 to 19 steps old; *ms / s*: milliseconds a simulated second; *by*:
shares of the steps of `ros2` with `solve = "factor"`. Errors without a number: the reference or the method did not
hold."""


def clock(device: str) -> str:
    """Whose time."""
    if device == "cpu":
        return "Milliseconds of the loop's thread by its own clock (parts: wall time); the first step is left out."
    return "Milliseconds of the device; the first step is left out."


def milliseconds(device: str) -> str:
    """About a table of costs."""
    whose = "processor time of the loop's thread" if device == "cpu" else "time of the device"
    return f"Milliseconds of {whose} a simulated second at the cheapest time step for an error:"
