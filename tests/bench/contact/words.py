# SPDX-License-Identifier: MIT
"""What the page of bench contact says. Figures stand in its tables."""

SETUP = """\
Bodies against obstacles, with friction, on a CPU in float64 ([how it works](../contact.md)). Where nothing else is
said: a block of 0.1 x 0.06 x 0.1 m, corotational tetrahedra, 1000 kg/m3, E = 0.3 MPa, Poisson's ratio 0.3, no
damping, friction 0.5, gravity 9.81 m/s2, backward Euler with steps of 1/60 s, `stiffness` (kappa) 1, at most 16
passes, contact tolerance 1e-3, solver tolerance 1e-6, at most 5,000 iterations a solve, factors by `lockstep-3`,
which repeats exactly. Times are milliseconds of processor time of the loop's thread; both cores of the machine were
busy with other work, so that they are above what an idle machine needs."""

ANSWERS = """\
Each line is computed when this page is made, by the simulation as it runs. *error*: relative, or absolute where 0 is
known. *at most*: what must hold. Blocks of 288 tetrahedra (4 x 3 x 4 cells), thickness 2 mm."""

WALL = """\
A bar of 1 x 0.1 x 0.1 m (E = 1 MPa, Poisson's ratio 0) hits a frictionless wall end on at 0.1 m/s. In one dimension
a wave of stress goes to the free end and back: contact lasts 2 L / c with a constant force rho c v S. Contact time
here: while the force exceeds half of that. Backward Euler damps the wave's sharp front, so the bar comes back
slower."""

HERTZ = """\
A rigid, frictionless ball of 0.1 m radius pressed on a block of 0.6 x 0.3 x 0.6 m held at its base (E = 0.1 MPa,
Poisson's ratio 0.3), quasi-statically; kappa 100. Known: F = 4/3 E / (1 - nu^2) sqrt(R) delta^1.5 on a half-space,
contact radius a = sqrt(R delta). Cells are smallest in the middle; *cells across a*: their size there over a. Linear
tetrahedra are too stiff, the block is no half-space, and nodes alone carry the force: the ratio falls with finer
meshes towards a value above 1."""

BELT = """\
A belt 2 mm thick, 10 mm wide (E = 10 MPa, 32 cells over half a turn), both ends held, over a cylinder (a capsule) of
50 mm radius that is raised by 3 mm and then turned slowly until the belt slips all over. Force and torque on the
cylinder give the tensions of both ends; known: T1 / T2 = e^(mu pi), Euler and Eytelwein."""

PATHS = """\
A block of 0.1 m with 26 surface nodes thrown at an obstacle, mostly downwards. Number: most surface nodes of any
step whose straight path led into the obstacle (1,500 points of each path); in brackets: nodes set back beside the
law in all steps (`clipped`), if any."""

PASSES = """\
Block of 8 x 5 x 8 cells. *creep*: at 0.5 degrees below the limit of friction 0.5. *v*: after one second from rest at
0.5 degrees beyond it. *stop*: way of a block sent off at 1 m/s, by friction. Last line: a rigid block in steps of
backward Euler. *sliding*: iterations of a step at friction 0.1; *resting*: of those of the first column. *contact*:
steps of all runs that ended with that status, as their contact residual was above the tolerance. The last solve of a
step, to the solver's tolerance, comes on top."""

COST = """\
*factor*: factors that learn of contact (`lockstep-3`; at 24,000 tetrahedra `lockstep-20`, as old as those of a
worker are there). *first factor*: that of the first matrix for ever, which knows of no contact. Both leave passes to
block Jacobi that it is expected to solve for less; its iterations, each of which costs a fraction of one with a
factor, count alike. *block Jacobi*: no factor at all. *iterations* and *passes* are sums and numbers of solves of a
step. *rest*: from one second on. *sliding*: at 3 m/s, friction 0.3. *impact without friction*: flat, 3 m/s from 0.3 m
above; *at*: the first six steps with passes, *after*: until step 40. *tumbling*: falls on a corner from 0.15 m,
60 steps. *not converged*: steps with another status than `converged`. Left out: tumbling at 24,000 tetrahedra with
kappa 100."""

FEW = """\
A round tool presses into a body, strokes it and leaves: steps in which it touches, of 100. *lockstep*: steps from a
matrix to its factor. *corrected*: for contacts that came or went since its matrix (`woodbury`, on by default); both
kinds of factors go over to block Jacobi in passes that it is expected to solve for less."""

IMPACT = "Iterations and processor time of each step of the impact, kappa 1. Each preconditioner makes the same motion."

GOALS = """\
3,000 tetrahedra a body. What was aimed at, and what came out: at rest the median, else the worst step of 40. About
10 contacts: on a pillar that is narrower than the block, so that its corners press into it; 100: on a floor; 1,000:
eight blocks on a floor, one after another in one thread (iterations: of the worst body). Flat impact at 3 m/s from
0.12 m above; oblique: with 3 m/s along the floor, friction 0.5. The goals of iterations are of those with a factor;
here those of block Jacobi count alike, though one costs a fraction."""

OWN = """\
A block of 3,000 tetrahedra, held at its top, hangs at rest, so that steps need next to no iterations. Contacts: a
pillar below presses on so many nodes. Obstacles far away are balls half a metre off. Cases take turns, five rounds
of 30 steps; times are the least of the medians of the rounds, *assemble* (wall time) has the search for what may
touch."""

STAIRS = """\
deploy/scenes/stairs.toml: the block on its way down, iterations and passes of each step and contacts that carry
force."""
