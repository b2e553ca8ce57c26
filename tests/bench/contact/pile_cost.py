# SPDX-License-Identifier: MIT
"""What a step of a pile of blocks costs, on a CPU or a GPU: they fall between walls and come to rest.

python -m tests.bench.contact.pile_cost --device gpu --bodies 50
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.bench.contact.bodies import CELLS, DT, SIZE, Row
from tests.contact.scenes import block, floor, over

PITCH = (0.125, 0.09, 0.125)  # m between blocks at the start
LAYER = 9  # blocks, 3 x 3


def pile(bodies: int, tets: int, solver: dict[str, Any], device: str) -> Simulation:
    """Layers of blocks, each turned a little, over a floor between four walls."""
    blocks = [
        block(
            0.5, CELLS[tets], SIZE, name=f"b{k}", rotate=(5 * np.sin(k), 4 * np.sin(3 * k), 5 * np.cos(2 * k)),
            at=(PITCH[0] * (k % 3), 0.02 + PITCH[1] * (k // LAYER), PITCH[2] * (k // 3 % 3)),
        )
        for k in range(bodies)
    ]  # fmt: skip
    inside, height = 3 * PITCH[0] + 0.03, 3.0
    middle = inside / 2 - 0.025
    walls: list[Row] = []
    for axis in (0, 2):
        for side in (-1, 1):
            size, place = [inside + 0.2, height, inside + 0.2], [middle, height / 2 - 0.1, middle]
            size[axis] = 0.1
            place[axis] = middle + side * (inside / 2 + 0.05)
            pose = {"translate": place}
            walls.append({"name": f"wall{axis}{side}", "shape": "box", "size": size, "pose": pose, "friction": 0.3})
    return over(floor(), *walls, objects=blocks, dt=DT, contact={"stiffness": 1.0}, solver=solver, device=device)


def summary(records: NDArray[Any], bodies: int) -> Row:
    """Times of steps [ms], iterations and passes of the body that has most, contacts of all."""
    whole = 1e3 * records["whole"].reshape(-1, bodies)[:, 0]
    of = {name: records[name].reshape(-1, bodies) for name in ("iterations", "passes", "contacts")}
    return {
        "p50 ms": round(float(np.median(whole)), 3), "p99 ms": round(float(np.percentile(whole, 99)), 3),
        "most ms": round(float(whole.max()), 3), "iterations": round(float(of["iterations"].max(axis=1).mean()), 1),
        "passes": round(float(of["passes"].max(axis=1).mean()), 2), "most passes": int(of["passes"].max()),
        "most iterations": int(of["iterations"].max()),
        "contacts": round(float(of["contacts"].sum(axis=1).mean()) / 2), "clipped": int(records["clipped"].sum()),
        "statuses": sorted(set(records["status"].tolist())),
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--device", default="gpu", choices=["cpu", "gpu"])
    parser.add_argument("--bodies", type=int, default=50)
    parser.add_argument("--tets", type=int, default=540, choices=list(CELLS))
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--preconditioner", default="cholesky", choices=["cholesky", "block_jacobi"])
    parser.add_argument("--update", default="every-20")
    o = parser.parse_args()
    solver: dict[str, Any] = {"preconditioner": o.preconditioner, "max_iterations": 1000}
    if o.preconditioner == "cholesky":
        solver["update"] = o.update
    sim = pile(o.bodies, o.tets, solver, o.device)
    driver, part = Driver(sim), 50
    for first in range(0, o.steps, part):
        records = np.concatenate([driver.advance(1) for _ in range(part)])
        sim.fetch()
        low, speed = float(sim.world.x[:, 1].min()), float(abs(sim.world.v).max())
        found = {"steps": f"{first}-{first + part}"} | summary(records, o.bodies) | {"low": low, "speed": speed}
        print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
