# SPDX-License-Identifier: MIT
"""Triangles of surfaces against obstacles on a GPU (device_faces.cuh): tables, memory and launches of their kernels."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32
from sim_server.backends.contact import Contact, Faces
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.cupy_types import DeviceArray, KernelFunction
from sim_server.backends.gpu.device import Gpu, compiled, options, own_headers

TEXT = Declarations("backends/gpu/faces.cu")
THREADS: int = TEXT.constant("CONTACT_THREADS")  # of a thread block
CORNERS: int = TEXT.constant("CORNERS")
FACE_ROW = TEXT.dtype("FaceRow")
KERNELS = ("detect_faces", "face_forces", "face_search", "sweep_faces", "finish_faces")
DEFINED = "-DFACE_ROWS"  # in texts of scenes with such rows


def corners_of_nodes(triangle: Int32, nodes: int) -> tuple[Int32, Int32]:
    """Returns CORNERS * triangle + corner of all corners, by node, ascending; the first of each node, (nodes + 1,)."""
    entry = (CORNERS * np.arange(len(triangle))[:, None] + np.arange(3)).ravel()
    order = np.argsort(triangle.ravel(), kind="stable")
    first = np.searchsorted(triangle.ravel()[order], np.arange(nodes + 1))
    return entry[order].astype(np.int32), first.astype(np.int32)


def links_of_corners(triangle: Int32, entry: Int32, row_start: Int32, columns: Int32) -> tuple[Int32, Int32, Int32]:
    """Returns what joins nodes of triangles in A: places of blocks among its values, those of a node together; the
    first one of each node, (nodes + 1,); and of each entry those to the next two corners, (entries, 2), -1: none."""
    nodes = len(row_start) - 1
    number, corner = np.divmod(entry, CORNERS)
    own = triangle[number, corner].astype(np.int64)
    others = np.stack([triangle[number, (corner + k) % 3] for k in (1, 2)], axis=1)
    keys = own[:, None] * nodes + others
    blocks = np.repeat(np.arange(nodes), np.diff(row_start)) * np.int64(nodes) + columns
    order = np.argsort(blocks)
    there = np.isin(keys, blocks)
    links = np.unique(keys[there])
    place = order[np.searchsorted(blocks[order], links)]
    of_entry = np.where(there, np.searchsorted(links, keys), -1)
    first = np.searchsorted(links // nodes, np.arange(nodes + 1))
    return place.astype(np.int32), first.astype(np.int32), of_entry.astype(np.int32)


class FaceRows:
    """Launches what triangles need beside nodes.

    contact: rows; its `faces` are there
    starts: (bodies + 1,) first node of each body
    arrays: host arrays by name

    What it keeps: link_place, places of blocks that rows share; memory (arrays by name).
    """

    def __init__(
        self, gpu: Gpu, contact: Contact, faces: Faces, starts: Int32, arrays: Mapping[str, NDArray[Any]], real: Any
    ):
        cp, bodies, nodes = gpu.cp, len(starts) - 1, len(arrays["x"])
        count, start = len(faces.triangle), contact.body_start[-1]
        entry, entry_start = corners_of_nodes(faces.triangle, nodes)
        self.link_place, link_start, entry_link = links_of_corners(
            faces.triangle, entry, arrays["row_start"], arrays["columns"]
        )
        site = np.full(nodes, -1, np.int32)
        node = contact.corner[:start:2, 0]
        site[node] = np.arange(len(node), dtype=np.int32)
        body = np.repeat(np.arange(bodies, dtype=np.int32), np.diff(faces.start))
        tables: dict[str, NDArray[Any]] = {
            "start": faces.start, "node": faces.triangle, "owns": faces.owns, "friction": faces.friction,
            "gravity": faces.gravity, "corner": contact.corner, "weight": contact.weight, "dropped": contact.dropped,
        }  # fmt: skip
        self.memory: dict[str, DeviceArray] = {name: gpu.twin(host, dtype=host.dtype) for name, host in tables.items()}
        made = {
            "body": body, "node_site": site, "node_start": starts, "entry_start": entry_start, "entry": entry,
            "entry_link": entry_link, "link_start": link_start, "link_place": self.link_place,
        }  # fmt: skip
        self.memory |= {name: cp.asarray(host) for name, host in made.items()}
        self.memory |= {name: cp.zeros((len(self.link_place), 3, 3), real) for name in ("base", "known")}
        self.memory |= {name: cp.zeros(bodies, np.int32) for name in ("rows", "counted", "entered", "clipped")}
        self.memory |= {"row": cp.zeros(count * FACE_ROW.itemsize, np.uint8), "sums": cp.zeros((bodies, 2))}
        self._bodies, self.grid = bodies, -(-count // THREADS)
        module = cp.RawModule(
            code=TEXT.checked(), options=(*options(gpu.types), *own_headers(), DEFINED), backend="nvrtc"
        )  # fmt: skip
        self._kernels: dict[str, KernelFunction] = {name: compiled("faces.cu", module, name) for name in KERNELS}

    def fill(self, params: Any) -> None:
        """Writes the addresses of its arrays into a DeviceFaces."""
        for name, array in self.memory.items():
            params[name] = array.data.ptr

    def launch(self, kernel: str, params: NDArray[Any]) -> None:
        """Appends one of its kernels. params: arguments of all kernels"""
        blocks = self.grid if kernel in ("detect_faces", "sweep_faces") else self._bodies
        self._kernels[kernel]((blocks,), (THREADS,), (params,))

    def known(self, out: Float64) -> None:
        """Writes the blocks that rows share, as a factor is to know them, to values of A."""
        out[self.link_place] = self.memory["known"].get()
