# SPDX-License-Identifier: MIT
"""Soft blocks over a floor in Newton, by its solver VBD: `python peer_newton.py PROBLEM.json RESULT.npz`.

It imports nothing of ours: the Python that runs it is one where `newton` is installed. What goes in and out is told in
peers.py. Contact with the floor begins at a particle's radius, between bodies at the margin of self contact: both are
the distance of the problem. On a GPU a frame is one CUDA graph.
"""

import json
import sys
import time
from pathlib import Path

import newton
import numpy as np
import warp as wp

WARM = 2  # frames before the clock starts: kernels are compiled then


def made(problem: dict) -> newton.Model:
    """y is up."""
    s = problem["settings"]
    builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=tuple(problem["gravity"]))
    young, poisson = problem["young"], problem["poisson"]
    for body in problem["bodies"]:
        builder.add_soft_mesh(
            pos=wp.vec3(0.0), rot=wp.quat_identity(), scale=1.0, vel=wp.vec3(*body["v"]),
            vertices=[wp.vec3(*x) for x in body["x"]], indices=[node for tet in problem["tets"] for node in tet],
            density=problem["density"], k_mu=young / (2 * (1 + poisson)),
            k_lambda=young * poisson / ((1 + poisson) * (1 - 2 * poisson)), k_damp=0.0,
            particle_radius=problem["distance"],
        )  # fmt: skip
    builder.add_ground_plane(
        cfg=newton.ModelBuilder.ShapeConfig(ke=s["ke"], kd=s["kd"], mu=problem["friction"], margin=0.0)
    )
    builder.color()
    model = builder.finalize(device=problem["device"])
    model.soft_contact_ke, model.soft_contact_kd = s["ke"], s["kd"]
    model.soft_contact_mu = problem["friction"]
    mass = np.concatenate([body["mass"] for body in problem["bodies"]])
    model.particle_mass.assign(mass.astype(np.float32))
    model.particle_inv_mass.assign((1 / mass).astype(np.float32))
    return model


class Run:
    """Model, solver and two states that take turns."""

    def __init__(self, problem: dict):
        s, several = problem["settings"], len(problem["bodies"]) > 1
        self.model, self.dt, self.substeps = made(problem), problem["dt"], problem["substeps"]
        self.solver = newton.solvers.SolverVBD(
            self.model, iterations=s["iterations"], friction_epsilon=s["friction_epsilon"],
            particle_enable_self_contact=several, particle_self_contact_margin=problem["distance"],
            particle_self_contact_gap=problem["distance"],
        )  # fmt: skip
        self.states = [self.model.state(), self.model.state()]
        self.control = self.model.control()
        self.pipeline = newton.CollisionPipeline(self.model, soft_contact_gap=s["gap"])
        self.contacts = self.pipeline.contacts()
        self.graph = None

    def substep(self) -> None:
        self.states[0].clear_forces()
        self.pipeline.collide(self.states[0], self.contacts)
        self.solver.step(self.states[0], self.states[1], self.control, self.contacts, self.dt)
        self.states.reverse()

    def frame(self) -> None:
        """An even number of substeps, or a copy, so that a graph finds its states in place."""
        for _ in range(self.substeps):
            self.substep()
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
    depth = np.maximum(problem["distance"] - np.array(x)[:, :, 1], 0)
    np.savez(sys.argv[2], x=np.array(x), seconds=np.array(seconds), floor=problem["settings"]["ke"] * depth.sum(axis=1),
             notes="",
             version=f"Newton {newton.__version__}, Warp {wp.config.version}")  # fmt: skip


if __name__ == "__main__":
    main()
