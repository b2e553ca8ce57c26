# SPDX-License-Identifier: MIT
"""Messages of a small made-up run, exact in every value: what recorder, reader, export and viewer are fed with."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from protocol import messages_pb2 as pb
from protocol.channels import PROTOCOL

REST = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], np.float64)
TETS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]], np.int32)
TRIANGLES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 4], [2, 3, 4], [3, 1, 4]], np.int32)
DT = 0.02


def header(name: str = "", epoch: int = 1, sequence: int = 0) -> pb.Header:
    return pb.Header(protocol=PROTOCOL, incarnation=7, object=name, epoch=epoch, sequence=sequence)


def scene(objects: list[str]) -> pb.Scene:
    return pb.Scene(header=header(), name="made-up.toml", dt=DT, objects=objects, software="test")


def topology(name: str, epoch: int = 1, rest: np.ndarray = REST, tets: np.ndarray = TETS) -> pb.Topology:
    return pb.Topology(
        header=header(name, epoch),
        nodes=len(rest),
        rest=rest.astype("<f8").tobytes(),
        tets=tets.astype("<i4").tobytes(),
        triangles=TRIANGLES.astype("<i4").tobytes(),
        fixed=np.array([0], "<i4").tobytes(),
        young=np.full(len(tets), 1e5, "<f4").tobytes(),
        poisson=np.full(len(tets), 0.25, "<f4").tobytes(),
    )


def positions(step: int, rest: np.ndarray = REST) -> np.ndarray:
    """Stretched along x a little more every step."""
    return rest * [1 + 0.01 * step, 1, 1]


def velocities(step: int, rest: np.ndarray = REST) -> np.ndarray:
    return np.full_like(rest, step / 8)


def state(name: str, step: int, epoch: int = 1, rest: np.ndarray = REST) -> pb.State:
    return pb.State(
        header=header(name, epoch, step),
        step=step,
        time=step * DT,
        nodes=len(rest),
        x=positions(step, rest).tobytes(),
        v=velocities(step, rest).tobytes(),
    )


def object_step(name: str, step: int) -> pb.ObjectStep:
    with_factor = step > 2
    return pb.ObjectStep(
        header=header(name, 1, step),
        step=step,
        time=step * DT,
        iterations=3 + step % 5,
        status=pb.MAX_ITERATIONS if step == 4 else pb.CONVERGED,
        residual=10.0**-6 / step,
        factor_step=step - 2 if with_factor else -1,
        factor_age=2 if with_factor else -1,
        preconditioner="cholesky" if with_factor else "block_jacobi",
        assemble_seconds=1e-3,
        solve_seconds=2e-3,
        integrate_seconds=1e-4,
        step_seconds=4e-3,
        fallbacks=0,
        excess=0.5 * step,
        **({"kinetic_energy": 10.0 * step, "gravity_energy": -1.0, "work": 0.5} if step > 1 else {}),
        **({"elastic_energy": 3.0 + step, "dissipated": 0.25 * step} if step % 3 == 0 else {}),
    )


def push(name: str) -> pb.Interaction:
    return pb.Interaction(
        id=1, client="c1", object=name, kind="push", point=pb.Vector(x=1, y=0, z=0), force=pb.Vector(y=-2), duration=0.1
    )


def record(path: Path, steps: int, names: tuple[str, ...] = ("beam",), compression: str = "lz4") -> Path:
    """Records frames 0..steps and steps 1..steps of every object."""
    from sim_server.recording.recorder import Recorder

    with Recorder(path, compression) as recorder:  # type: ignore[arg-type]
        recorder.scene(scene(list(names)))
        for name in names:
            recorder.topology(topology(name))
            recorder.state(state(name, 0), block=True)
        for step in range(1, steps + 1):
            for name in names:
                recorder.step(object_step(name, step), block=True)
                recorder.state(state(name, step), block=True)
            if step == 2:
                recorder.interaction(push(names[0]), step * DT)
    return path
