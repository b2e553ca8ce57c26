# SPDX-License-Identifier: MIT
"""What the page of bench contact says. Figures stand in its tables."""

SHORT = """\
[How it works](../contact.md); the sections below say how each of these was measured."""

SETUP = """\
Bodies against obstacles and each other, with friction, in float64. Where nothing else is said: a block of 0.1 x 0.06
x 0.1 m, corotational tetrahedra, 1000 kg/m3, E = 0.3 MPa, Poisson's ratio 0.3, no damping, friction 0.5, gravity
9.81 m/s2, backward Euler with steps of 1/60 s, `stiffness` (kappa) 1, at most 16 passes, contact tolerance 1e-3,
solver tolerance 1e-6, at most 5,000 iterations a solve, factors by `lockstep-3`, which repeats exactly. Times of
steps: on a CPU processor time of the loop's thread, on a GPU from the first to the last kernel, each by its own
clock."""

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
matrix to its factor. *corrected*: for contacts that came or went since its matrix (`woodbury`, on by default); on a CPU
both kinds of factors go over to block Jacobi in passes that it is expected to solve for less. *a hand*: so many nodes
of a beam of 3,000 tetrahedra, in the column contacts, each held by a spring of so many of its own blocks of A: the
steps until a factor knows it."""

IMPACT = """\
A block falls flat on a floor at 3 m/s, without friction, kappa 1. *at*: the first six steps with passes; *after*:
the rest. Each way makes the same motion. *factor*: as it is by default, corrected for contacts that came or
went since its matrix where that pays (`woodbury`); *not corrected*: `woodbury = 0`. *no factor while in contact*:
block Jacobi in steps after one that touched something, as Courtecuisse et al. 2010 put a factor aside after cuts,
until one comes that knows them. *first factor*: that of the first matrix for ever."""

GOALS = """\
3,000 tetrahedra a body. What was aimed at, and what came out: at rest the median, else the worst step of 40. About
10 contacts: on a pillar that is narrower than the block, so that its corners press into it; 100: on a floor; 1,000:
eight blocks on a floor, on a CPU one after another in one thread (iterations: of the worst body). Flat impact at 3
m/s from 0.12 m above; oblique: with 3 m/s along the floor, friction 0.5. The goals of iterations are of those with a
factor; here those of block Jacobi count alike, though one costs a fraction."""

OWN = """\
A block of 3,000 tetrahedra, held at its top, hangs at rest, so that steps need next to no iterations. Contacts: a
pillar below presses on so many nodes. Obstacles far away are balls half a metre off. Cases take turns, five rounds
of 30 steps in one run; times are the least of the medians of the rounds, *assemble* (wall time) has the search for
what may touch."""

PILE = """\
The lowest blocks of deploy/scenes/pile.toml, 540 tetrahedra each, between four walls; the loop in one thread,
factors made beside it. *falling*: the first 90 steps; *rest*: steps 150 to 210. *in real time*: 99 of 100 steps take
less than dt, while they fall, or only at rest."""

PEERS = """\
The same block of 540 tetrahedra (nodes, tetrahedra, masses, E = 0.3 MPa, Poisson's ratio 0.3, no damping), one or
four of them over each other, in MuJoCo (flex) and Newton (SolverVBD), friction 0.5. Contact begins 1 mm from a node
in all of them, and depths are told from there: a node 1 mm deep is at the floor itself. *drop*: from 50 mm; *at
rest*: after 1.5 s. *stop*: way from 1 m/s; known: v^2 / (2 mu g) - v dt / 2, which steps of dt make of it. *creep*:
of a block held by friction on a slope so much below the limit, from one second on, over half a second; known: 0.
*between blocks*: lowest node over the top face below. A frame is 1/60 s.

Laws differ: ours is linear corotational in float64, contact stiff as a node is, friction with a memory. MuJoCo's
flex is St. Venant-Kirchhoff in float64; its contacts are soft by design and regularized in friction, so that all
creep a little. It runs with `integrator="discrete"`, which takes elasticity implicitly, the Newton solver, elliptic
cones and `impratio="100"` as its documentation advises against slow slip (its `noslip` pass is refused with flexes
there), `solref` and `solimp` of its own example of a soft bar on a floor; MuJoCo raises a time constant of contact
to twice the time step. Newton's VBD is Neo-Hookean in float32, contact a penalty of 1e5 N/m without damping as in
its examples of soft bodies, friction smoothed below `friction_epsilon`, 0.01 m/s by default and 0.001 m/s in
*sharper friction*: what slides slower than that is not held. Ten steps a frame and ten iterations are what its
examples take, fifty come nearer to its converged answer; what few iterations leave over acts as a force from
outside, as the speed without friction shows. Times are medians of frames; on a CPU processor time of the whole
process, ours with all that makes factors, in one thread; on a GPU Newton's wall time of a frame as a CUDA graph, and
ours by the clock of the device. *the loop alone*: ours without what makes factors, which workers do elsewhere.
*warnings* are MuJoCo's own."""

STAIRS = """\
deploy/scenes/stairs.toml: the block on its way down, iterations and passes of each step and contacts that carry
force."""

ITSELF = """\
With `contact.self`, beside the same without it, in turns. What is nowhere near itself is not searched: how far it has
moved since distances were measured tells that ([how](../contact.md#how-it-works)). Without the key the arms pass
through each other, and their steps are those of a body that touches nothing."""
