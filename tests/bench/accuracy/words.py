# SPDX-License-Identifier: MIT
"""What the page of bench accuracy says. Figures stand in its tables, and in sentences that are made of them."""

SETUP = """\
Four scenes: *beam* (`deploy/scenes/beam.toml`, corotational), *heterogeneous beam*
(`deploy/scenes/heterogeneous.toml`, three stiffnesses 100:5:1), *neo-Hookean beam*
(`tests/bench/accuracy/neo_hookean.toml`, without damping), *block on a floor*
(`tests/bench/accuracy/on_floor.toml`: begins to touch it, sags and comes to rest). Where nothing else is said: the
time step of the file (20 ms; block 10 ms), backward Euler, one linearization, tolerance 1e-6, `cholesky` with
`update = "lockstep-4"`, whose factors are 4 to 7 steps old, the first one of the first matrix. They are made
between steps and not counted: of a server a worker on another core makes them. A factor that a step waits for
(`every-1`) is counted.

Errors are distances of nodes from where they are in another run on the same mesh with the same law, the largest of
all nodes and steps. *Error*: from the motion that small steps make: explicit substeps (beam, neo-Hookean beam),
Newmark with Newton-Raphson (heterogeneous beam), backward Euler at two small time steps, extrapolated (block).
Damping of the stiffness is by the tangent, which schemes choose: in the heterogeneous beam the small steps have
that of the scheme they are compared with. *Error of the steps*: from the trajectory of the same time steps of
backward Euler, each solved to rounding. Errors do not depend on how busy the machine was; times are processor time
of the loop's thread by its own clock, on a GPU time of the device, without the first step. L is the length of the
beam, the width of the block. Each point's settings, as `sim-server SCENE --set KEY=VALUE` takes them, are in
accuracy.csv."""

SHORT = """\
Error against time, neo-Hookean beam, E = 1 MPa. Each curve is a method at several settings, each beside the motion
that small steps of its own law make. Crosses at the edge: ran away, failed or took too long."""

SOURCES = """\
Each source alone, as the scene is: *linear solve*: as it is, beside linear solves to 1e-12; *linearization*: beside
each step solved to rounding; *time step*: steps solved to rounding, beside small steps; *mesh*: beside a mesh twice
as fine; *model*: beside another law with the same constants, which is no error but tells what the choice of the law
decides. They are not to be added: one may make up for a part of another. *All together*: the scene as it is beside
small steps."""

STEPS = """\
Largest error of the steps over L, and the time of a step. *1, 2, 4*: always so many linearizations (the nonlinear
tolerance is out of reach); *up to 8*: to a nonlinear tolerance; *position*: to a bound of the error of each step in
metres, `[accuracy] position`. *unconverged*: steps with a linear system, or a contact, that was not solved."""

ORDERS = """\
Exponents p of error ~ (time step)^p between neighbours, from the largest time step to the smallest; errors are root
mean squares over nodes and times (L2), and those near the uncertainty of the reference are left out. *Should be* is
that of a smooth motion, each step solved. One linearization keeps Newmark and BDF2 at 1 where elements are
compressed; a beam that is let go begins to vibrate in modes that long time steps do not follow, which keeps schemes
of second order below 2 until steps are short; explicit substeps are not here, since a shorter time step does not
make them shorter."""

MESHES = """\
Distance of each mesh from the next finer one, root mean square over times and the nodes of the coarsest mesh (L2),
by the same small steps on all of them; p from each three neighbours. It should be 2 for a smooth solution. That of the
*block on rollers* is one (`tests/bench/accuracy/on_rollers.toml`): in equilibrium and plane strain, one cell thick,
bent by a moment, held along the normals of planes alone. A beam that is held at a whole face has a singularity along
that face's edges, and coarse meshes of linear tetrahedra are too stiff: both make it smaller."""

AXES = """\
One axis at a time, or the two that matter together. Horizontal: error; vertical: seconds of a simulated second.
Crosses at the right edge: ran away, failed or took too long. *tolerance, linearizations* is against the error of
the steps, *tolerance, preconditioner* and *drop tolerance* (at 1e-6) against the error of the linear solves alone
(from a run of the same steps, one linearization each, with linear solves to 1e-12): the time step would hide both.
Age and precision of the factor change the time alone, but for ros2, which has the factor as its matrix. *mesh*:
beside 16 cells across, at the nodes that both have. *model*: each law beside its own small steps."""

CELLS = "In the cells: error [mm], seconds of a simulated second."

EFFECTIVITY = """\
Estimated over true error of each step, over 60 steps: 1 is right, below 1 an estimate says too little.
*solve_error*: of the linear solve, beside the same system solved to rounding; *step_error*: of the step's own
equation. Steps with a true error that is rounding are left out, and those without an estimate. Twins begin each
step where the run does."""

PEERS = """\
The neo-Hookean beam with E = 1 and 10 MPa, each beside the small steps of its own law: MuJoCo (St. Venant and
Kirchhoff) beside its RK4, Newton's semi-implicit solver and PyBullet (neo-Hookean with a logarithm) beside their own,
Newton's VBD (the law of this scene) and ours beside our explicit substeps, SciPy with CHOLMOD (beam.toml: corotational)
beside ours of that scene. *reference*: how far its small steps are from those twice as long. *error of the steps*: of
VBD, SciPy and backward Euler, from steps of the same length solved exactly. Same mesh, no damping (beam.toml: 0.1/s),
same masses, but in PyBullet one mass for all nodes. Times of others are processor time of the whole process without its
start and compilation, on a GPU wall time; ours are as above, SciPy's step factorizes itself. Processor time is longer
where the load of a run is above the cores, up to twice as long."""
