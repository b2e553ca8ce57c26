# SPDX-License-Identifier: MIT
"""What it takes to know that one linearization is enough, part by part, as changes of a whole step: launches of a graph
overlap in part, so that times of single kernels would not add up to it."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np

from sim_server.backends.gpu.kernel_fusion import fuse
from sim_server.backends.gpu.newton import NewtonIteration
from sim_server.backends.gpu.step_sequence import StepSequence
from tests.bench.gpu.problem import Problem
from tests.bench.gpu.steps import Beams, Search, rounds

ONE, ALLOWED = Search(1, 1, 1e-6), Search(4, 1, 1e-6)


@contextmanager
def forces_twice() -> Iterator[None]:
    """Steps whose first assembly has its kernels over elements and nodes once more, to the same results."""
    beginning = StepSequence._beginning

    def twice(sequence: StepSequence, assemble: Any, *rest: Any, **more: Any) -> Any:
        forces = fuse([launch for launch in assemble if launch.domain != "blocks"])
        return [*forces, *beginning(sequence, assemble, *rest, **more)]

    with patch.object(StepSequence, "_beginning", twice):
        yield


@contextmanager
def without_loop() -> Iterator[None]:
    """Steps that end after their first trial, right where one linearization is enough."""

    def launch(iteration: NewtonIteration) -> None:
        assert iteration._begins_beside and iteration._ends_within
        iteration._trial(iteration._params, None, None)

    with patch.object(NewtonIteration, "launch", launch):
        yield


def microseconds(tets: int, search: Search, count: int, library: str, settings: tuple[str, ...]) -> float:
    """p50 of a step."""
    problem = Problem(tets, law="stable_neo_hookean", dt=0.02)
    scene = Beams(problem, library, overrides=("solver.projection=clamp", *search.overrides, *settings))
    return 1e6 * float(np.median(np.concatenate(rounds(scene, count, 0).records)["whole"]))


def parts(tets: int, count: int, library: str, settings: tuple[str, ...]) -> dict[str, Any]:
    """A row: us of a step of one linearization, of one that may have four, and of the parts that this has more."""
    one, whole = (microseconds(tets, search, count, library, settings) for search in (ONE, ALLOWED))
    with forces_twice():
        forces = microseconds(tets, ALLOWED, count, library, settings) - whole
    with without_loop():
        loop = whole - microseconds(tets, ALLOWED, count, library, settings)
    return {
        "tets": tets, "one, us": one, "four allowed, us": whole, "forces at its end": forces, "loop not entered": loop,
        "the rest": whole - one - forces - loop, "of one": whole / one,
        "of one, were the forces reused": (whole - forces) / one,
    }  # fmt: skip
