# SPDX-License-Identifier: MIT
"""One checkout's side of a comparison: a process that runs the code of a checkout as it is told, line by line.

`python side.py CHECKOUT` reads orders, one JSON object a line, and answers each by one. It uses only what both have in
common, so the checkout may be of another commit; the benchmarks are always those of this one.
"""

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

HERE, CHECKOUT = Path(__file__).resolve().parents[3], Path(sys.argv[1]).resolve()
Answer = dict[str, Any]


def _use_the_other() -> None:
    """Imports come from the checkout from now on, but for `tests`, which are those of this file's."""
    sys.path.insert(0, str(HERE))
    import tests

    tests.__path__ = [str(HERE / "tests")]
    sys.meta_path[:] = [finder for finder in sys.meta_path if "editable" not in repr(finder).lower()]
    sys.path[:] = [str(CHECKOUT), *(path for path in sys.path if path and Path(path).resolve() != HERE)]
    os.environ["PYTHONPATH"] = str(CHECKOUT)
    os.chdir(CHECKOUT)


_use_the_other()

from protocol.factor import FactorPattern  # noqa: E402
from sim_server.errors import InputError  # noqa: E402
from sim_server.scene import load as load_scene  # noqa: E402
from sim_server.simulation import Simulation  # noqa: E402

try:
    from precond_worker.factorize import Analysis  # before it had a folder
except ImportError:
    from precond_worker.factorization.factorize import Analysis  # type: ignore[assignment]

scenes: dict[str, Simulation] = {}
analyses: dict[str, Analysis] = {}


def written(text: str, folder: str) -> Path:
    """The scene as a file; without the words that say the default of commits which had no other."""
    path = Path(folder) / "scene.toml"
    path.write_text(text)
    try:
        load_scene(path)
    except InputError:
        path.write_text(text.replace(', split = "kuhn"', "").replace('elements = "linear"\n', ""))
    return path


def load(name: str, text: str, overrides: list[str], device: str) -> Answer:
    """Loads a scene under a name."""
    begun = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        scenes[name] = Simulation.load(written(text, folder), overrides, device=device)
    return {"nodes": scenes[name].world.nodes, "seconds": time.perf_counter() - begun}


def drop(name: str) -> Answer:
    """Forgets a scene, and its memory."""
    del scenes[name]
    analyses.pop(name, None)
    return {}


def analysis_of(name: str, library: str) -> Analysis:
    """Of the first body's pattern, made once."""
    if name not in analyses:
        sim = scenes[name]
        body = sim.world.bodies[0]
        analyses[name] = Analysis(*sim.system.body_pattern(body.first, body.last), library=library)
    return analyses[name]


def factor(name: str, file: str, library: str) -> Answer:
    """Begins a step on a CPU and leaves the factor of its matrix in a file."""
    engine, analysis = scenes[name].engine, analysis_of(name, library)
    engine.assemble()
    begun = time.perf_counter()
    values = analysis.factorize(engine.factor_matrix(0), np.float32)
    seconds, p = time.perf_counter() - begun, analysis.pattern
    np.savez(
        file, values=values, permutation=p.permutation, super_start=p.super_start, row_start=p.row_start, rows=p.rows
    )
    return {"seconds": seconds}


def turn(name: str, file: str, begun: bool, steps: int) -> Answer:
    """Steps on a CPU with the factor in a file. begun: the first one is assembled."""
    engine = scenes[name].engine
    with np.load(file) as found:
        parts = [found[key] for key in ("permutation", "super_start", "row_start", "rows")]
        values = found["values"]
    engine.post_factor(0, FactorPattern.build(*parts), values, step=engine.step)
    if begun:
        engine.solve()
    engine.run(steps - begun)
    r = engine.records()[1:]  # the first one of one run has a factorization within
    rate = 2 * values.nbytes * r["iterations"].sum() / r["solve"].sum()  # L and its transpose, once an iteration
    ms = 1e3 * (r["assemble"] + r["solve"] + r["integrate"])
    return {"ms": ms.tolist(), "iterations": r["iterations"].tolist(), "GB/s": 1e-9 * float(rate)}


def round(name: str, library: str, variants: int, steps: int, counted: bool = False) -> Answer:
    """A step whose matrices make new factors, handed over while no step waits; then steps with these.

    counted: the first one is told, too.
    """
    sim, analysis = scenes[name], analysis_of(name, library)
    engine = sim.engine
    body = sim.world.bodies[0]
    blocks = len(sim.system.body_pattern(body.first, body.last)[1])
    targets = [np.empty((blocks, 3, 3)) for _ in range(variants)]
    for index, target in enumerate(targets):
        engine.request_matrix(index, target)
    first = _run(sim, 1)
    while any(engine.matrix_step(index) < 0 for index in range(variants)):
        time.sleep(1e-4)
    step, begun = engine.matrix_step(0), time.perf_counter()
    factors = [analysis.factorize(target) for target in targets]
    made = time.perf_counter()
    for body in sim.world.bodies:
        engine.post_factor(body.index, analysis.pattern, factors[body.index % variants], step)
    engine.settle_factors()
    taken = time.perf_counter()
    records = np.concatenate([first, _run(sim, steps)]) if counted else _run(sim, steps)
    return _told(records) | {"factor ms": 1e3 * (made - begun), "taken ms": 1e3 * (taken - made)}


def run(name: str, steps: int) -> Answer:
    """Steps without a pause, of a thread whose records another one fetches each millisecond, as in a server."""
    engine, found = scenes[name].engine, list[NDArray[Any]]()
    engine.records()
    with ThreadPoolExecutor(1) as pool:
        loop = pool.submit(engine.run, steps)
        while not loop.done():
            found.append(engine.records())
            time.sleep(1e-3)
        loop.result()
    return _told(np.concatenate([*found, engine.records()]))


def _run(sim: Simulation, steps: int) -> NDArray[Any]:
    """Records of so many steps, in pieces whose records find room in the loop's ring."""
    sim.engine.records()
    piece, found = max(1, 4096 // len(sim.world.bodies)), []
    for done in range(0, steps, piece):
        sim.engine.run(min(piece, steps - done))
        found.append(sim.engine.records())
    return np.concatenate(found)


def _told(records: NDArray[Any]) -> Answer:
    first = records[records["body"] == 0]
    return {
        "ms": (1e3 * first["whole"]).tolist(), "host us": (1e6 * first["cpu"]).tolist(),
        "iterations": records["iterations"].reshape(len(first), -1).mean(axis=1).tolist(),
        "most": int(records["iterations"].max()), "residual": float(records["residual"].max()),
    }  # fmt: skip


def motion(name: str, exact: str, steps: int, every: int) -> Answer:
    """Steps of two scenes from where both begin, one with a factor each so many steps and one that is to be exact.

    Returns: times of the former, and how far it is from the latter at most, over the length of the body.
    """
    ours, reference = scenes[name], scenes[exact]
    length = float(np.ptp(ours.fetch().x, axis=0).max())
    told, most = list[Answer](), 0.0
    for _ in range(steps // every):
        told.append(round(name, "auto", 1, every - 1, counted=True))
        _run(reference, every)
        most = max(most, float(np.linalg.norm(ours.fetch().x - reference.fetch().x, axis=1).max()) / length)
    ms = [value for answer in told for value in answer["ms"]]
    iterations = [value for answer in told for value in answer["iterations"]]
    return {"ms": ms, "iterations": iterations, "error": most}


def real_time(text: str, seconds: float, dt: float, device: str, worker: str) -> Answer:
    """A server in real time with one worker."""
    from tests.bench.gpu.first_factor import served

    first = "go" if "first_factor" in (CHECKOUT / "sim_server/scene/solver_options.py").read_text() else ""
    with tempfile.TemporaryDirectory() as folder:
        return served(written(text, folder), first, device, worker, seconds, dt)


def many(text: str, seconds: float, device: str, worker: str, first: float) -> Answer:
    """A server as fast as it goes with one worker and many bodies."""
    from tests.bench.speed.many import served

    with tempfile.TemporaryDirectory() as folder:
        return served(written(text, folder), device, worker, seconds, first)


def swinging(beams: int, tets: int, device: str, worker: str, first: float, seconds: float) -> Answer:
    """Many bodies in this process that are put back again and again, with a worker process."""
    from tests.bench.gpu.many_factors import measure

    measured = (measure if (CHECKOUT / "sim_server/recording").exists() else _swinging_older)(
        beams, tets, device, worker, first, seconds
    )
    measured.pop("threads us/factor", None)  # which no table holds
    return measured


def _swinging_older(beams: int, tets: int, device: str, worker: str, first: float, seconds: float) -> Answer:
    """The same of commits whose modules had other names: by the bench that they have for one body."""
    from tests.bench.gpu.many_factors import watched
    from tests.bench.gpu.problem import Problem

    _tests_of(CHECKOUT)
    try:
        from sim_server import describe  # type: ignore[attr-defined]
        from tests.bench._gpu_served import Served  # type: ignore[import-not-found]
    finally:
        _tests_of(HERE)
    load("many", Problem(tets, beams=beams).text(), [], device)
    sim, adopted = scenes["many"], list[int]()
    with Served(sim, worker) as served:
        for body in sim.world.bodies[1:]:
            served.link.announce(describe.topology(sim, body))
        served.driver.adopted = lambda factor: adopted.append(factor.step)
        row = watched(served.driver.pump, lambda: len(adopted), beams, first, seconds)
    drop("many")
    return {"beams": beams, "tets": tets, "worker": worker, "schedule": "excess", **row}


def _tests_of(checkout: Path) -> None:
    """Has `tests` be those of a checkout."""
    import tests

    tests.__path__ = [str(checkout / "tests")]
    for name in [name for name in sys.modules if name.startswith("tests.")]:
        del sys.modules[name]


def sofa(tets: int, steps: int) -> Answer:
    """SOFA's beam on one thread with a worker process, as fast as it goes: steps that had a factor."""
    from tests.bench.cpu.__main__ import with_worker

    return with_worker(tets, steps)


ORDERS: dict[str, Callable[..., Answer]] = {
    function.__name__: function
    for function in (load, drop, factor, turn, round, run, motion, real_time, many, swinging, sofa)
}


def main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what anything else prints is no answer
    for line in sys.stdin:
        order = json.loads(line)
        try:
            answer = {"answer": ORDERS[order.pop("do")](**order)}
        except Exception as error:
            answer = {"refused": f"{type(error).__name__}: {error}"}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
