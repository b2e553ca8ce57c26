# SPDX-License-Identifier: MIT
"""A soft bar held at some nodes in Newton, VBD or semi-implicit: `python peers_newton.py PROBLEM.json RESULT.npz`.

It imports nothing of ours: the Python that runs it is one where `newton` is installed. What goes in and out is told in
peers.py. Everything is float32. VBD has the stable neo-Hookean law of the problem; that of the semi-implicit solver has
a logarithm more and gets constants with which small strains agree. On a GPU a frame is one CUDA graph.
"""

import json
import sys
import time
from pathlib import Path

import newton
import numpy as np
import warp as wp

WARM = 1  # frames before the clock starts: kernels are compiled then


def constants(problem: dict) -> tuple[float, float]:
    """Of the solver's own law."""
    young, poisson = problem["young"], problem["poisson"]
    mu, lam = young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    return (mu, lam) if problem["settings"]["solver"] == "VBD" else (4 / 3 * mu, lam + 5 / 6 * mu)


def made(problem: dict) -> newton.Model:
    """With the masses of the problem."""
    mu, lam = constants(problem)
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=tuple(problem["gravity"]))
    builder.add_soft_mesh(
        pos=wp.vec3(0.0), rot=wp.quat_identity(), scale=1.0, vel=wp.vec3(0.0),
        vertices=[wp.vec3(*x) for x in problem["x"]], indices=[node for tet in problem["tets"] for node in tet],
        density=problem["density"], k_mu=mu, k_lambda=lam, k_damp=0.0, particle_radius=1e-4,
    )  # fmt: skip
    builder.color()
    model = builder.finalize(device=problem["device"])
    mass = np.array(problem["mass"], dtype=np.float32)
    mass[problem["held"]] = 0.0
    inverse = np.divide(1.0, mass, out=np.zeros_like(mass), where=mass > 0)
    model.particle_mass.assign(mass)
    model.particle_inv_mass.assign(inverse)
    flags = model.particle_flags.numpy()
    flags[problem["held"]] &= ~int(newton.ParticleFlags.ACTIVE)
    model.particle_flags.assign(flags)
    return model


class Run:
    """Model, solver and two states that take turns."""

    def __init__(self, problem: dict):
        s, self.model = problem["settings"], made(problem)
        self.dt, self.substeps = problem["dt"], problem["substeps"]
        if s["solver"] == "VBD":
            self.solver = newton.solvers.SolverVBD(
                self.model, iterations=s["iterations"], particle_enable_self_contact=False
            )
        else:
            self.solver = newton.solvers.SolverSemiImplicit(self.model, enable_tri_contact=False)
        self.states = [self.model.state(), self.model.state()]
        self.control = self.model.control()

    def frame(self) -> None:
        """An even number of substeps, or a copy, so that a graph finds its states in place."""
        for _ in range(self.substeps):
            self.states[0].clear_forces()
            self.solver.step(self.states[0], self.states[1], self.control, None, self.dt)
            self.states.reverse()
        if self.substeps % 2:
            self.states[1].assign(self.states[0])
            self.states.reverse()

    def reset(self) -> None:
        for state in self.states:
            state.assign(self.model.state())


def main() -> None:
    problem = json.loads(Path(sys.argv[1]).read_text())
    wp.config.quiet = True
    with wp.ScopedDevice(problem["device"]):
        run = Run(problem)
        for _ in range(WARM):
            run.frame()
        frame, clock = run.frame, time.process_time
        if wp.get_device().is_cuda:
            clock = time.perf_counter
            with wp.ScopedCapture() as capture:
                run.frame()
            frame = lambda: wp.capture_launch(capture.graph)  # noqa: E731
        run.reset()
        x, seconds = [], []
        for _ in range(problem["frames"]):
            wp.synchronize()
            begun = clock()
            frame()
            wp.synchronize()
            seconds.append(clock() - begun)
            x.append(run.states[0].particle_q.numpy().astype(float))
    np.savez(sys.argv[2], x=np.array(x), seconds=np.array(seconds), notes="", diverged="",
             version=f"Newton {newton.__version__}, Warp {wp.config.version}")  # fmt: skip


if __name__ == "__main__":
    main()
