# SPDX-License-Identifier: MIT
"""Attachments and springs on a GPU (ties.cu): what its kernels are given."""

from typing import Any

import numpy as np

from sim_server.arrays import Int32
from sim_server.backends.gpu.cupy_types import DeviceArray
from sim_server.backends.gpu.device import Gpu
from sim_server.backends.ties import Ties

TABLES = (
    "body", "obstacle", "table", "point", "kappa", "rest", "breaking", "stiffness", "force", "broken", "reaction",
)  # fmt: skip


def bindings(ties: Ties) -> tuple[Int32, Int32, Int32, Int32]:
    """Returns nodes that may be bound to another body, ascending, the first tie of each, these ties and the bodies."""
    joined = (ties.kappa > 0) & (ties.body[:, 1] >= 0)
    tie, corner = np.nonzero((ties.corner >= 0) & joined[:, None])
    node, other = ties.corner[tie, corner], ties.body[tie, (corner == 0).astype(int)]
    order = np.lexsort((tie, node))
    bound, first = np.unique(node[order], return_index=True)
    start = np.append(first, len(node)).astype(np.int32)
    return bound.astype(np.int32), start, tie[order].astype(np.int32), other[order].astype(np.int32)


def tie_arguments(gpu: Gpu, ties: Ties, nodes: int, broken: Int32, params: Any) -> dict[str, DeviceArray]:
    """Sets the part of ISLAND_ARGUMENTS that is of attachments and springs; returns memory to be kept.

    nodes: of the scene. broken: (ties,) host memory that the steps write to
    """
    cp, bodies, n, ints = gpu.cp, len(ties.reaction), len(ties.corner), np.int32
    node, *binding = bindings(ties)
    order = np.argsort(ties.table, kind="stable").astype(ints)
    kept = {name: gpu.twin(host, dtype=host.dtype) for name in TABLES for host in [getattr(ties, name)]} | {
        "start": cp.asarray(np.searchsorted(ties.body[:, 0], np.arange(bodies + 1)).astype(ints)),
        "order": cp.asarray(order), "start_force": cp.zeros((n, 3)), "slope": cp.zeros((n, 6)),
        "bound": cp.zeros(nodes, ints),
    }  # fmt: skip
    lists = dict(zip(("bound_start", "bound_tie", "bound_other"), map(cp.asarray, binding), strict=True)) | {
        "bound_node": cp.asarray(node),
        "table_start": cp.asarray(np.searchsorted(ties.table[order], np.arange(ties.tables + 1)).astype(ints)),
    }  # fmt: skip
    for name, array in kept.items():
        params["ties"][name] = array.data.ptr
    for name, array in lists.items():
        params[name] = array.data.ptr
    params["ties"]["count"], params["ties"]["tables"] = n, ties.tables
    params["ties"]["columns"], params["ties"]["column_first"] = ties.reaction.shape[1], ties.column
    params["bound_nodes"], params["broken_on_host"] = len(node), broken.ctypes.data
    return {**kept, **lists}
