# SPDX-License-Identifier: MIT
"""Topology and State messages as checked arrays, safe to index with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from protocol.refused import Refused
from protocol.validate import array, check_range


@dataclass(frozen=True)
class Mesh:
    """One topology epoch of an object."""

    object: str
    epoch: int
    rest: NDArray[np.float64]  # (n, 3) posed rest positions [m]
    tets: NDArray[np.int32]  # (m, 4)
    triangles: NDArray[np.int32]  # (t, 3) outer surface
    fixed: NDArray[np.int32]  # (k,)
    young: NDArray[np.float32]  # (m,) [Pa]; empty = not elastic
    poisson: NDArray[np.float32]  # (m,)


@dataclass(frozen=True)
class Frame:
    """Positions and velocities of an object after a step."""

    object: str
    epoch: int
    step: int
    time: float  # s
    x: NDArray[np.float64]  # (n, 3) [m]
    v: NDArray[np.float64]  # (n, 3) [m/s]


def mesh_of(message: pb.Topology) -> Mesh:
    """Checks a topology and returns its arrays. Raises Refused."""
    n, name = message.nodes, f"Topology of {message.header.object!r}"
    if n == 0:
        raise Refused(f"{name}: nodes is 0; allowed: at least 1", "shape")
    tets = array(message.tets, np.int32, (-1, 4), f"{name}: tets")
    triangles = array(message.triangles, np.int32, (-1, 3), f"{name}: triangles")
    fixed = array(message.fixed, np.int32, (-1,), f"{name}: fixed")
    for values, what in ((tets, "tets"), (triangles, "triangles"), (fixed, "fixed")):
        check_range(values, 0, n, f"{name}: {what}")
    return Mesh(
        object=message.header.object,
        epoch=message.header.epoch,
        rest=array(message.rest, np.float64, (n, 3), f"{name}: rest", finite=True),
        tets=tets,
        triangles=triangles,
        fixed=fixed,
        young=_per_tet(message.young, len(tets), f"{name}: young"),
        poisson=_per_tet(message.poisson, len(tets), f"{name}: poisson"),
    )


def frame_of(message: pb.State) -> Frame:
    """Checks a state and returns its arrays; after a solve that diverged they may hold NaN. Raises Refused."""
    n, name = message.nodes, f"State of {message.header.object!r} at step {message.step}"
    if n == 0:
        raise Refused(f"{name}: nodes is 0; allowed: at least 1", "shape")
    x = array(message.x, np.float64, (n, 3), f"{name}: x")
    v = array(message.v, np.float64, (n, 3), f"{name}: v")
    return Frame(message.header.object, message.header.epoch, message.step, message.time, x, v)


def _per_tet(data: bytes, tets: int, what: str) -> NDArray[np.float32]:
    return array(data, np.float32, (tets if data else 0,), what)
