# SPDX-License-Identifier: MIT
"""Runs a scene in a process of its own, by the packages of a folder, and tells what it took and what came out.

A program: `python -P absent_effect.py SCENE STEPS` in that folder prints a report, then takes numbers of steps on lines
and prints the processor seconds of each batch. With `--forks` it takes jobs on lines, each with files that are not to
be there, and prints a report of each; each job is a fork of a process that has imported no effect.
"""

import hashlib
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("sim_server", "protocol", "precond_worker")
COUNTED = ("kernels", "bytes", "network", "log")


def report(scene: str, steps: int) -> tuple[dict[str, Any], Any]:
    """What a scene took to be built and run for some steps, and the simulation.

    state: digest of positions and velocities; moved: largest velocity [m/s]
    launches: kernel and items; modules: all that are imported; texts: that were compiled
    counted: totals of an explanation; asked: effects that asked for something in it
    """
    import sim_server
    from sim_server.backends.compiler import compiled
    from sim_server.simulation import Simulation

    simulation = Simulation.load(scene)
    simulation.engine.run(steps)
    world = simulation.fetch()
    modules = sorted(sys.modules)
    texts = sorted(set(compiled))
    from sim_server.explain.explanation import explain

    found = explain(scene)
    return {
        "state": hashlib.sha256(world.x.tobytes() + world.v.tobytes()).hexdigest(),
        "moved": float(abs(world.v).max()),
        "launches": [[launch.name, launch.items] for launch in simulation.step_launches],
        "modules": modules, "texts": texts, "counted": {name: found.totals[name] for name in COUNTED},
        "asked": [each.name for each in found.asked], "folder": str(Path(sim_server.__file__ or "").parent.parent),
    }, simulation  # fmt: skip


def copy_packages(folder: Path, without: Iterable[str] = ()) -> None:
    """Copies what a simulation needs into a folder. without: files of sim_server/effects that are left out."""
    ignored = shutil.ignore_patterns("__pycache__", "*.obj", "*.msh")  # meshes of the gallery
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package, ignore=ignored)
    for file in without:
        (folder / "sim_server" / "effects" / file).unlink()


def start(folder: Path, *arguments: str) -> "subprocess.Popen[str]":
    """Starts this program with the packages of a folder."""
    return subprocess.Popen(
        [sys.executable, "-P", str(Path(__file__).resolve()), *arguments], cwd=folder, text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=os.environ | {"PYTHONPATH": str(folder)},
    )  # fmt: skip


def ask(process: "subprocess.Popen[str]", question: str = "") -> Any:
    """Writes a line to a process that was started here, unless it is empty, and returns its answer, parsed."""
    assert process.stdin is not None and process.stdout is not None
    if question:
        process.stdin.write(question + "\n")
        process.stdin.flush()
    answer = process.stdout.readline()
    if not answer:
        raise RuntimeError(f"{process.args} ended with code {process.wait()}")
    return json.loads(answer)


def _serve(scene: str, steps: int) -> None:
    found, simulation = report(scene, steps)
    print(json.dumps(found), flush=True)
    for line in sys.stdin:
        begin = time.thread_time()
        simulation.engine.run(int(line))
        print(json.dumps(time.thread_time() - begin), flush=True)


def _serve_forks() -> None:
    import sim_server.explain.explanation  # all but effects: a fork has it
    import sim_server.simulation

    effects = Path(sim_server.simulation.__file__).parent / "effects"
    for line in sys.stdin:
        job = json.loads(line)
        hidden = [(effects / name, effects / f"{name}.hidden") for name in job["without"]]
        for there, away in hidden:
            there.rename(away)
        child = os.fork()
        if not child:
            _answer(job["scene"], job["steps"])
        os.waitpid(child, 0)
        for there, away in hidden:
            away.rename(there)


def _answer(scene: str, steps: int) -> None:
    """Prints a report, or the error, and ends the process."""
    try:
        found, _ = report(scene, steps)
    except Exception as error:
        found = {"error": f"{type(error).__name__}: {error}"}
    print(json.dumps(found), flush=True)
    sys.exit()


if __name__ == "__main__":
    if sys.argv[1] == "--forks":
        _serve_forks()
    else:
        _serve(sys.argv[1], int(sys.argv[2]))
