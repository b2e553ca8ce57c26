# SPDX-License-Identifier: MIT
"""Checkouts in turns, each in a process of its own: the rows of what they measure."""

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench.cpu.__main__ import CELLS, SCENE, STEPS
from tests.bench.gpu.problem import Problem
from tests.bench.harness.pieces import say

TURN = 8  # steps of a CPU from one factor
AGE = 16  # steps of a GPU from one factor
Row = dict[str, Any]


class Side:
    """The process of a checkout."""

    def __init__(self, checkout: Path):
        program = Path(__file__).with_name("side.py")
        self._process = subprocess.Popen(
            [sys.executable, str(program), str(checkout)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __call__(self, do: str, **order: Any) -> Row:
        """Gives an order and waits for its answer."""
        self.begin(do, **order)
        return self.end()

    def begin(self, do: str, **order: Any) -> None:
        """Gives an order."""
        assert self._process.stdin is not None
        print(json.dumps({"do": do, **order}), file=self._process.stdin, flush=True)

    def end(self) -> Row:
        """Returns the answer; raises RuntimeError if the order failed or the process has ended."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        answered = json.loads(line) if line else {"refused": "its process has ended"}
        if "refused" in answered:
            raise RuntimeError(answered["refused"])
        answer: Row = answered["answer"]
        return answer

    def close(self) -> None:
        """Ends the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()


Sides = dict[str, Side]


@contextmanager
def sides_of(checkouts: dict[str, Path]) -> Iterator[Sides]:
    """Has a process for each."""
    sides: Sides = {}
    try:
        for name, checkout in checkouts.items():
            sides[name] = Side(checkout)
        yield sides
    finally:
        for side in sides.values():
            side.close()


def everywhere(sides: Sides, do: str, **order: Any) -> dict[str, Row]:
    """An order that all carry out at once."""
    for side in sides.values():
        side.begin(do, **order)
    return {name: side.end() for name, side in sides.items()}


def percentiles(values: Sequence[float]) -> Row:
    """p50, p99, max."""
    p50, p99, most = np.percentile(values, [50, 99, 100]).tolist()
    return {"p50": p50, "p99": p99, "max": most}


def threads(sides: Sides, tets: int, numbers: Sequence[int], turns: int) -> list[Row]:
    """Steps of SOFA's beam on some numbers of threads; all with the factors that the last side makes."""
    overrides = [f"object.beam.mesh.bar=[{', '.join(map(str, CELLS[tets]))}]"]
    for n in numbers:
        more = {"text": SCENE.read_text(), "overrides": [*overrides, f"solver.threads={n}"], "device": "cpu"}
        everywhere(sides, "load", name=f"{n}", **more)
    found: dict[tuple[str, int], list[Row]] = {(side, n): [] for n in numbers for side in sides}
    maker, first = list(sides)[-1], numbers[0]
    with tempfile.TemporaryDirectory() as folder:
        file = f"{folder}/factor.npz"
        for _ in range(turns):
            sides[maker]("factor", name=f"{first}", file=file, library="auto")
            for (side, n), rows in found.items():
                rows.append(sides[side]("turn", name=f"{n}", file=file, begun=(side, n) == (maker, first), steps=TURN))
    for n in numbers:
        everywhere(sides, "drop", name=f"{n}")
    return [
        {"what": "threads", "tets": tets, "threads": n, "side": side, **_ms(rows),
         "GB/s of L": float(np.median([row["GB/s"] for row in rows]))}
        for (side, n), rows in found.items()
    ]  # fmt: skip


def sofa(sides: Sides, tets: int, rounds: int) -> list[Row]:
    """Steps of SOFA's beam with a worker process: processor time of the loop's thread, and wall time."""
    found: dict[str, list[Row]] = {name: [] for name in sides}
    for _ in range(rounds):
        for name, side in sides.items():
            found[name].append(side("sofa", tets=tets, steps=STEPS[tets]))
    rows = []
    for name, runs in found.items():
        every = {key: [v for run in runs for v in run[key]] for key in ("cpu", "wall", "iterations", "age")}
        walls = {f"wall {key}": value for key, value in percentiles(every["wall"]).items()}
        means = {"iterations": float(np.mean(every["iterations"])), "factor age": float(np.mean(every["age"]))}
        label = {"what": "sofa", "tets": tets, "side": name}
        rows.append({**label, **percentiles(every["cpu"]), **walls, **means, "steps": len(every["cpu"])})
    return rows


def steps(
    sides: Sides, problem: Problem, rounds: int, library: str, device: str, long: int = 0, settings: Sequence[str] = ()
) -> list[Row]:  # fmt: skip
    """Steps with factors at most AGE steps old. long: of them without a pause after that, for the host's time."""
    for name, answer in everywhere(
        sides, "load", name="beam", text=problem.text(), overrides=[], device=device
    ).items():
        say(f"{name}: {problem.name} loaded in {answer['seconds']:.1f} s")
    order = {"name": "beam", "library": library, "variants": problem.variants, "steps": AGE}
    everywhere(sides, "round", **order)  # warms up; what is made once a topology takes seconds
    found: dict[str, list[Row]] = {name: [] for name in sides}
    for _ in range(rounds):
        for name, side in sides.items():
            found[name].append(side("round", **order))
    runs = {name: [side("run", name="beam", steps=long)] if long else found[name] for name, side in sides.items()}
    everywhere(sides, "drop", name="beam")
    label = {"what": "steps", "tets": problem.tets, "material": problem.material, "beams": problem.beams}
    label |= {"settings": " ".join(settings)} if settings else {}
    return [
        {**label, "side": name, **_ms(rows), "most": max(row["most"] for row in rows),
         "residual": max(row["residual"] for row in rows),
         "factor ms": float(np.median([row["factor ms"] for row in rows])),
         "in use ms": float(np.median([row["taken ms"] for row in rows])),
         "host us": float(np.mean([us for row in runs[name] for us in row["host us"]]))}
        for name, rows in found.items()
    ]  # fmt: skip


def _ms(rows: Sequence[Row]) -> Row:
    ms, iterations = ([value for row in rows for value in row[key]] for key in ("ms", "iterations"))
    return {**percentiles(ms), "iterations": float(np.mean(iterations)), "steps": len(ms)}


def motion(sides: Sides, label: Row, text: str, ours: list[str], exact: list[str], device: str) -> list[Row]:
    """Steps of a motion, and its error against one that solves each step exactly."""
    rows = []
    for name, side in sides.items():
        side("load", name="ours", text=text, overrides=ours, device=device)
        side("load", name="exact", text=text, overrides=exact, device=device)
        answer = side("motion", name="ours", exact="exact", steps=60, every=3)
        rows.append({"what": "motion", **label, "side": name, **_ms([answer]), "error": answer["error"]})
    return rows


def in_turn(sides: Sides, what: str, label: Row, **order: Any) -> list[Row]:
    """A measurement with servers, of one side after the other."""
    return [{"what": what, **label, "side": name, **side(what, **order)} for name, side in sides.items()]
