# SPDX-License-Identifier: MIT
"""Where the time of a step of a pile goes on a GPU: its kernels one by one, launched from the host, with times between
events around each (some microseconds of each are the events').

python -m tests.bench.contact.pile_kernels --bodies 50
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import argparse
from collections import defaultdict
from typing import Any

import numpy as np

from sim_server.updates.driver import Driver
from tests.bench.contact.pile_cost import pile


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("--bodies", type=int, default=50)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--update", default="every-20")
    o = parser.parse_args()
    solver = {"preconditioner": "cholesky", "update": o.update, "max_iterations": 1000}
    sim = pile(o.bodies, 540, solver, "gpu")
    Driver(sim).advance(o.steps)
    engine: Any = sim.engine
    cp, contact = engine.gpu.cp, engine._contact
    islands, spent = contact.islands, defaultdict(list)

    def timed(name: str, launch: Any) -> None:
        begin, end = cp.cuda.Event(), cp.cuda.Event()
        begin.record()
        launch()
        end.record()
        spent[name].append((begin, end))

    own, factors = islands._launch, islands._solver.apply_island_factors
    islands._launch = lambda kernel, *a: timed(kernel, lambda: own(kernel, *a))
    islands._solver.apply_island_factors = lambda a: timed("island_factor", lambda: factors(a))
    engine.assemble()
    cp.cuda.Device().synchronize()
    islands.detect()
    islands.group()
    contact._launch("begin_contact", contact._bodies)
    contact._launch("contact_forces", contact.grid)
    contact._solve_and_search(contact.first)
    passes = iterations = rounds = 0

    def flag(name: str) -> bool:
        return bool(islands.flag(name).get()[0])

    while flag("go"):
        rounds += 1
        if flag("active"):
            islands.start()
            while flag("active") and passes < 100:
                islands.begin_pass()
                while flag("iterating"):
                    islands.iterate()
                    iterations += 1
                islands.end_pass()
                passes += 1
        for kernel, blocks, given in (
            ("pair_boxes", islands._bodies, (1,)), ("pair_trees", islands._bodies, (1,)),
            ("pair_sweep", -(-islands._sites // islands._threads), ()), ("end_sweep", 1, ()),
        ):  # fmt: skip
            islands._launch(kernel, blocks, *given)
        if flag("go"):
            islands.group(1)
    islands.keep()
    islands.know(contact.memory["values"])
    cp.cuda.Device().synchronize()
    print(f"{passes} passes, {iterations} iterations, {rounds} rounds; tally {islands.tally.get()}")
    rows = []
    for name, events in spent.items():
        us = np.array([1e3 * cp.cuda.get_elapsed_time(*e) for e in events])
        rows.append(
            (
                us.sum(),
                f"{name:18} {len(us):6} x  median {np.median(us):8.2f} us  most {us.max():8.2f}  sum {us.sum():10.1f}",
            )
        )
    for _, line in sorted(rows, reverse=True):
        print(line)


if __name__ == "__main__":
    main()
