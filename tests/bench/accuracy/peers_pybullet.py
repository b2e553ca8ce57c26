# SPDX-License-Identifier: MIT
"""A soft bar held at some nodes in PyBullet: `python peers_pybullet.py PROBLEM.json RESULT.npz`.

It imports nothing of ours: the Python that runs it is one where `pybullet` is installed. What goes in and out is told
in peers.py. Its law is neo-Hookean with a logarithm and gets constants with which small strains agree. All nodes have
the same mass, together that of the problem; there is no damping.
"""

import json
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pybullet as p

TETRAHEDRON = 10  # in VTK


def constants(problem: dict) -> tuple[float, float]:
    """Of its law."""
    young, poisson = problem["young"], problem["poisson"]
    mu, lam = young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))
    return 4 / 3 * mu, lam + 5 / 6 * mu


def mesh_text(problem: dict) -> str:
    """Legacy VTK, which is what it reads."""
    points, tets = problem["x"], problem["tets"]
    lines = ["# vtk DataFile Version 2.0", "bar", "ASCII", "DATASET UNSTRUCTURED_GRID"]
    lines += [f"POINTS {len(points)} double", *(" ".join(f"{c:.17g}" for c in x) for x in points)]
    lines += [f"CELLS {len(tets)} {5 * len(tets)}", *("4 " + " ".join(map(str, tet)) for tet in tets)]
    return "\n".join([*lines, f"CELL_TYPES {len(tets)}", *[str(TETRAHEDRON)] * len(tets), ""])


def made(problem: dict) -> int:
    """The body, in a world with nothing else in it."""
    file = Path("bar.vtk").absolute()
    file.write_text(mesh_text(problem))
    mu, lam = constants(problem)
    p.resetSimulation(p.RESET_USE_DEFORMABLE_WORLD)
    p.setGravity(*problem["gravity"])
    p.setTimeStep(problem["dt"])
    body = p.loadSoftBody(
        str(file), simFileName=str(file), mass=sum(problem["mass"]), useNeoHookean=1, NeoHookeanMu=mu,
        NeoHookeanLambda=lam, NeoHookeanDamping=0.0, useSelfCollision=0, collisionMargin=1e-4,
    )  # fmt: skip
    for node in problem["held"]:
        p.createSoftBodyAnchor(body, node, -1, -1)
    return int(body)


def positions(body: int) -> np.ndarray:
    """Of the nodes, (n, 3) [m]."""
    return np.array(p.getMeshData(body, -1, flags=p.MESH_DATA_SIMULATION_MESH)[1], dtype=float)


def main() -> None:
    problem = json.loads(Path(sys.argv[1]).read_text())
    p.connect(p.DIRECT)
    body = made(problem)
    start = np.array(problem["x"])
    if (found := positions(body)).shape != start.shape or np.abs(found - start).max() > 1e-5:
        raise SystemExit(f"the nodes it has, {found.shape}, are not those of the mesh, {start.shape}")
    x, seconds = [], []
    for _ in range(problem["frames"]):
        begun = time.process_time()
        for _ in range(problem["substeps"]):
            p.stepSimulation()
        seconds.append(time.process_time() - begun)
        x.append(positions(body))
    moved = float(np.abs(np.array(x)[:, problem["held"]] - start[problem["held"]]).max())
    notes = f"held nodes moved by {moved:.2g} m" if moved > 1e-6 else ""
    np.savez(sys.argv[2], x=np.array(x), seconds=np.array(seconds), notes=notes, diverged="",
             version=f"PyBullet {version('pybullet')}")  # fmt: skip


if __name__ == "__main__":
    main()
