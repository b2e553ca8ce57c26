# SPDX-License-Identifier: MIT
"""Where the error of a scene comes from, source by source, and orders of convergence."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np

from clients.accuracy.sources import LINEAR, LINEARIZATION, MESH, MODEL, length
from clients.accuracy.sources import TIME as STEP
from clients.accuracy.trajectories import shared_nodes
from tests.bench.accuracy.cases import NEWTON, Case, Settings, usual
from tests.bench.accuracy.motion import Motion, error, exact_solve, exact_step, move, reference, rms

Row = dict[str, Any]
COMPARED = {
    LINEAR: "as the scene is, and with linear solves to 1e-12",
    LINEARIZATION: "one linearization, and the step's equation solved to rounding",
    STEP: "steps solved to rounding, and small steps",
    MESH: "this mesh, and one twice as fine",
    MODEL: "this law, and {law} with the same constants",
}
FIRST = {  # to change
    LINEAR: "a smaller `solver.tolerance`",
    LINEARIZATION: "a second linearization, or `accuracy.position`",
    STEP: "a smaller `dt`, or a scheme of second order",
    MESH: "a finer mesh",
}
CELLS = (2, 4, 8, 16)  # across, of the meshes that tell the order; four times as many along
PLANE_CELLS = (4, 8, 16, 32, 64)  # likewise, of what is strained in a plane alone


def rows(case: Case) -> list[Row]:
    """Errors [m] of a scene as its file is, each source alone: the largest distance of a node at any time."""
    as_is, solved = move(case, usual()), exact_solve(case)
    exact, true = exact_step(case, {}), reference(case)
    other = reference(case, case.with_law(case.laws[0]))
    fine = on_mesh(case, _finer(case.cells))
    found = {
        LINEAR: error(as_is, solved), LINEARIZATION: error(solved, exact), STEP: error(exact, true.motion),
        MESH: error(on_mesh(case, case.cells), fine), MODEL: error(true.motion, other.motion),
    }  # fmt: skip
    law = case.laws[0].replace("_", " ")
    return [
        {"scene": case.name, "source": source, "compared": COMPARED[source].format(law=law),
         "error": value, "length": case.length, "all together": error(as_is, true.motion), "apart": true.apart}
        for source, value in found.items()
    ]  # fmt: skip


def sentence(scene: str, found: Mapping[str, float | None]) -> str:
    """Which source dominates a scene, and what to change first. found: errors [m] by source, None if not known.

    The model is no error of the computation: it is told apart where it is the largest.
    """
    known = {source: value for source, value in found.items() if value is not None and source != MODEL}
    if not known:
        return f"{scene}: no source is known."
    first, *others = sorted(known, key=lambda source: -known[source])
    rest = ", ".join(f"{source} {length(known[source])}" for source in others)
    said = f"{scene}: the {first} dominates with {length(known[first])}{f' ({rest})' if rest else ''}; first change: "
    said += f"{FIRST[first]}."
    if (model := found.get(MODEL)) is not None and model > known[first]:
        said += f" Another law moves it by {length(model)}, more than any of these: be sure of the law."
    return said


# --- orders -----------------------------------------------------------------------------------------------------------


def orders(sizes: Sequence[float], errors: Sequence[float | None], floor: float = 0.0) -> list[float]:
    """Exponents p of error ~ size^p between neighbours, from the largest size to the smallest.

    What is not known, or below three times the floor, is left out.
    """
    known = sorted(
        ((h, e) for h, e in zip(sizes, errors, strict=True) if e is not None and np.isfinite(e) and e > 3 * floor),
        reverse=True,
    )
    return [float(np.log(e1 / e2) / np.log(h1 / h2)) for (h1, e1), (h2, e2) in pairwise(known)]


@cache
def on_mesh(case: Case, cells: tuple[int, int, int]) -> Motion:
    """The motion on another mesh, by small steps: the same ones on all meshes of a scene. What settles does so."""
    if case.settled:
        settings: Settings = usual(case.meshed(cells), NEWTON)
    elif case.explicit:
        coarse = 2 * float(reference(case).settings["dt"])
        settings = usual(case.meshed(cells), {"integrator.scheme": "central_difference"}, case.stepped(coarse))
    else:
        scheme = {} if case.contact else {"integrator.scheme": "newmark"}
        newton = {"integrator.linearizations": "3", "solver.tolerance": "1e-4", "solver.update": "lockstep-20"}
        settings = usual(case.meshed(cells), scheme, newton, case.stepped(case.dt / 4))
    return move(case, settings, limit=np.inf)


def _finer(cells: tuple[int, int, int]) -> tuple[int, int, int]:
    a, b, c = cells
    return 2 * a, 2 * b, 2 * c


def of_meshes(case: Case, cells: Sequence[int] = CELLS) -> list[Row]:
    """How far each mesh is from the next finer one, in L2: root mean square [m] over the nodes of the coarsest one."""
    motions = [on_mesh(case, (n, 1 if case.settled else n, 4 * n)) for n in cells]
    nodes = motions[0]
    return [
        {"scene": case.name, "cells across": n, "tets": coarse.tets, "h m": 1.0 / n, "length": case.length,
         "rms to the next finer": rms(_at(coarse, nodes), _at(fine, nodes)), "largest": error(coarse, fine)}
        for n, coarse, fine in zip(cells, motions, motions[1:], strict=False)
    ]  # fmt: skip


def _at(motion: Motion, nodes: Motion) -> Motion:
    """The same at the nodes of a coarser mesh alone."""
    kept, _ = shared_nodes(motion.rest, nodes.rest)
    return replace(motion, frames=motion.frames[:, kept], rest=motion.rest[kept])
