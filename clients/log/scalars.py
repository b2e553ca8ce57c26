# SPDX-License-Identifier: MIT
"""Scalars per step of an object as columns: names, types and order for export, plots and tables."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb

Columns = dict[str, NDArray]

# Names as in the ObjectStep message; seconds are wall-clock, time is simulated.
DTYPES: dict[str, str] = {
    "step": "i8",
    "time": "f8",  # s
    "iterations": "i8",
    "residual": "f8",  # true, |b - A dv| / |b|
    "status": "U24",
    "factor_step": "i8",  # -1: no factor
    "factor_age": "i8",  # steps; -1: no factor
    "preconditioner": "U24",
    "assemble_seconds": "f8",
    "solve_seconds": "f8",
    "integrate_seconds": "f8",
    "step_seconds": "f8",
    "late_seconds": "f8",
    "cpu_seconds": "f8",
    "fallbacks": "i8",
    "excess": "f8",
    "factor_age_bound": "i8",  # steps; -1: none known
    "linearizations": "i8",  # of Newton-Raphson; 0: the scene has one a step
    "nonlinear_residual": "f8",  # of the step's first |b|
    "kinetic_energy": "f8",  # J; this and the next four are NaN where they were not recorded
    "elastic_energy": "f8",  # J; recorded in some steps
    "gravity_energy": "f8",  # J; zero at the origin
    "work": "f8",  # J, of pushes and grabs since the start
    "dissipated": "f8",  # J since the start
}
ENERGIES = ("kinetic_energy", "elastic_energy", "gravity_energy", "work", "dissipated")


def status_name(value: int) -> str:
    """Names a SolveStatus, e.g. 'converged' or 'max_iterations'; 'unknown_7' if this version does not know it."""
    return pb.SolveStatus.Name(value).lower() if value in pb.SolveStatus.values() else f"unknown_{value}"  # type: ignore[arg-type]


def row(message: pb.ObjectStep) -> tuple:
    """Returns the values of one step in the order of DTYPES."""
    return tuple(_value(message, name) for name in DTYPES)


def _value(message: pb.ObjectStep, name: str) -> object:
    if name == "status":
        return status_name(message.status)
    return math.nan if name in ENERGIES and not message.HasField(name) else getattr(message, name)  # type: ignore[arg-type]


def columns(rows: Iterable[tuple]) -> Columns:
    """Returns one array per scalar, ascending in step."""
    table = list(zip(*sorted(rows, key=lambda r: r[0]), strict=True)) or [()] * len(DTYPES)
    return {name: np.array(values, dtype) for (name, dtype), values in zip(DTYPES.items(), table, strict=True)}
