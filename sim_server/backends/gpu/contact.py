# SPDX-License-Identifier: MIT
"""Contact on a GPU (contact_state.cuh): memory and launches of its kernels, between assembly and integration. Bodies
that touch each other: islands.py."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32
from sim_server.backends.contact import Contact
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.correction import FactorCorrection
from sim_server.backends.gpu.cupy_types import DeviceArray, KernelFunction
from sim_server.backends.gpu.device import Gpu, compiled, options, own_headers
from sim_server.backends.gpu.energies import node_chunks
from sim_server.backends.gpu.faces import DEFINED, FaceRows
from sim_server.backends.gpu.host_results import ContactResults
from sim_server.backends.gpu.island_memory import SharedContact
from sim_server.backends.gpu.islands import Graphs, IslandPasses
from sim_server.backends.gpu.solver import PcgSolver
from sim_server.backends.gpu.state import device_arrays
from sim_server.backends.gpu.structs import CONTACT_SOLVE, CONTACT_STATE
from sim_server.backends.state import StateArray

TEXT = Declarations("backends/gpu/contact.cu")
THREADS: int = TEXT.constant("CONTACT_THREADS")  # of a thread block, each with a node
SUMS: int = TEXT.constant("CONTACT_SUMS")
CONTACT_ARGUMENTS, DEVICE_ROW = TEXT.dtype("ContactArguments"), TEXT.dtype("DeviceRow")
KERNELS = ("begin_contact", "contact_forces", "contact_search", "finish_contact")
TABLE = ("kind", "size", "grid", "place", "cells", "begin", "end")  # arrays of obstacles
ROWS = (
    "body_start", "obstacle", "normal", "gap", "drift", "entry", "stiffness", "friction", "thickness",
    "hardening", "force", "traction",
)  # fmt: skip


def pairs_of(contact: Contact, nodes: int) -> Int32:
    """Returns the first of the two rows against obstacles of each node, (nodes,); -1: it has none.

    Raises ValueError for rows that are not pairs of one node.
    """
    count = contact.body_start[-1]
    node = contact.corner[:count, 0]
    alone = (contact.corner[:count, 1:] < 0).all() and (contact.weight[:count, 0] == 1).all()
    if len(node) % 2 or not alone or (node[::2] != node[1::2]).any():
        raise ValueError("rows of contact on a GPU come in pairs, of one node each")
    pair = np.full(nodes, -1, np.int32)
    pair[node[::2]] = np.arange(0, len(node), 2)
    return pair


def own_blocks(row_start: Int32, columns: Int32) -> Int32:
    """Returns the place of each node's own block among the values of A, (nodes,)."""
    rows = np.repeat(np.arange(len(row_start) - 1), np.diff(row_start))
    return np.flatnonzero(rows == columns).astype(np.int32)


class ContactPasses:
    """Launches the solves of a step with contact.

    contact: rows, and options
    ranges: nodes [first, last) of each body
    arrays: host arrays by name (row_start, columns, values, b, y, x, rotation)
    balance: energy balances of the bodies on the device, which get the work of contact
    results: memory of the host that the steps write to
    correction: of factors; None: they are not corrected

    Tests run its kernels with what it keeps: grid (thread blocks), params (arguments of the kernels), first and later
    (of the solver, in the first solve of a step and in passes), active (bodies that are not over), memory (arrays by
    name).
    """

    def __init__(
        self, gpu: Gpu, device: Graphs, contact: Contact, ranges: Sequence[tuple[int, int]],
        arrays: Mapping[str, NDArray[Any]], solver: PcgSolver, balance: DeviceArray, results: ContactResults,
        correction: FactorCorrection | None = None,
    ):  # fmt: skip
        cp, nodes, self._bodies = gpu.cp, len(arrays["x"]), len(ranges)
        self._gpu, self._device, self._solver, self.active = gpu, device, solver, cp.zeros(1, np.int32)
        starts = np.array([first for first, _ in ranges] + [nodes], np.int32)
        chunks, rows, real = node_chunks(starts, THREADS), len(contact.obstacle), solver.real
        self.grid, names = len(chunks), ("values", "b", "y", "x", "rotation")
        own, pair = own_blocks(arrays["row_start"], arrays["columns"]), pairs_of(contact, nodes)
        self._surface = own[contact.corner[: contact.body_start[-1] : 2, 0]]  # places of the nodes that have rows
        sites = len(self._surface)
        exact = {name: getattr(contact, name) for name in ROWS}
        self.memory: dict[str, DeviceArray] = {name: gpu.twin(arrays[name]) for name in names}
        self.memory |= {name: gpu.twin(host, dtype=host.dtype) for name, host in exact.items()}
        self.memory |= {name: gpu.twin(getattr(contact, name)) for name in ("predictor", "free")}
        self.memory |= {
            "pair": cp.asarray(pair), "node": cp.asarray(contact.corner[:, 0].copy()), "place": cp.asarray(own),
            "contact_b": cp.zeros((nodes, 3), real), "start": cp.zeros((nodes, 3), real),
            "first": cp.zeros((nodes, 3), real), "last": cp.zeros((nodes, 3), real),
            "base": cp.zeros((max(sites, 1), 3, 3), real), "known": cp.zeros((max(sites, 1), 3, 3), real),
            "row": cp.zeros(max(rows, 1) * DEVICE_ROW.itemsize, np.uint8),
            "list": cp.zeros(max(rows, 1), np.int32), "active": self.active,
            "state": cp.zeros(self._bodies * CONTACT_STATE.itemsize, np.uint8),
            "chunks": cp.asarray(chunks.view(np.int32)), "partial_sums": cp.zeros((len(chunks), SUMS)),
            "finished_chunks": cp.zeros(self._bodies, np.uint32), "pool_counter": solver.pool_counter,
            "results": solver.results, "step": solver.counter, "balance": balance,
        }  # fmt: skip
        self._table = {n: gpu.twin(a, dtype=a.dtype) for n in TABLE for a in [getattr(contact.obstacles, n)]}
        self.faces = FaceRows(gpu, contact, contact.faces, starts, arrays, real) if contact.faces else None
        self.params = self._arguments(contact, results)
        if correction:
            correction.connect(self.memory["pair"], self.memory["base"], self.params)
        self.islands: IslandPasses | None = None
        if contact.surfaces or contact.ties:
            shared = SharedContact(self.params, chunks, THREADS, self.faces)
            self.islands = IslandPasses(gpu, device, contact, ranges, arrays, solver, shared, results)
        self.first, self.later = self._solve(contact, 1), self._solve(contact, 0)
        module = cp.RawModule(
            code=TEXT.checked(), options=(*options(gpu.types), *own_headers(), *([DEFINED] if self.faces else [])),
            backend="nvrtc",
        )  # fmt: skip
        self._kernels: dict[str, KernelFunction] = {name: compiled("contact.cu", module, name) for name in KERNELS}

    def state(self) -> list[StateArray]:
        """Returns what steps carry on beside the rows that launches write."""
        found = device_arrays("engine.contact", self.memory, "row", "state", "base", "known")
        if self.faces:
            found += device_arrays("engine.faces", self.faces.memory, "base", "known")
        return found + (self.islands.state() if self.islands else [])

    def _arguments(self, contact: Contact, results: ContactResults) -> NDArray[Any]:
        """Returns the arguments of all kernels."""
        params: Any = np.zeros((), CONTACT_ARGUMENTS)
        for name, array in self.memory.items():
            params[name] = array.data.ptr
        for name, array in self._table.items():
            params["obstacles"][name] = array.data.ptr
        if self.faces:
            self.faces.fill(params["faces"])
        params["contact_results"] = results.solves.ctypes.data
        params["reactions"], params["capacity"] = results.reactions.ctypes.data, len(results.reactions)
        params["dx_dv"], params["force_coefficient"] = contact.dx_dv, contact.force_coefficient
        params["tolerance"], params["obstacle_count"] = contact.tolerance, len(contact.obstacles.kind)
        params["count"], params["passes"] = self._bodies, contact.passes
        return params  # type: ignore[no-any-return]

    def _solve(self, contact: Contact, first_of_step: int) -> NDArray[Any]:
        """Returns the arguments of a solve."""
        solve = np.zeros((), CONTACT_SOLVE)
        for name in ("state", "first", "last"):
            solve[name] = self.memory[name].data.ptr
        solve["tolerance"], solve["passes"], solve["first_of_step"] = contact.tolerance, contact.passes, first_of_step
        return solve

    @property
    def poses(self) -> int:
        """Device address of where obstacles are at the end of a step, (obstacles, 7)."""
        return int(self._table["end"].data.ptr)

    def _launch(self, kernel: str, blocks: int) -> None:
        self._kernels[kernel]((blocks,), (THREADS,), (self.params,))

    def _launch_faces(self, *kernels: str) -> None:
        for kernel in kernels if self.faces else ():
            assert self.faces is not None
            self.faces.launch(kernel, self.params)

    def detect(self) -> None:
        """Appends the detection that is no launch of an effect, once a step: it turns what rows remember with their
        normals."""
        self._launch_faces("detect_faces")
        if self.islands:
            self.islands.detect()

    @property
    def detects(self) -> bool:
        """Whether there is such detection."""
        return bool(self.islands or self.faces)

    def begin(self) -> None:
        """Appends what comes before the first solve of a step whose rows are detected."""
        if self.islands:
            self.islands.begin_ties()
            self.islands.group()
        self._launch("begin_contact", self._bodies)
        self._forces()

    def _forces(self) -> None:
        self._launch_faces("face_forces")
        self._launch("contact_forces", self.grid)

    def launch(self) -> None:
        """Appends the solves of such a step, while a graph is captured."""
        self.begin()
        self._solve_and_search(self.first)
        with self._device.repeat(self.active):
            self._forces()
            self._solve_and_search(self.later)
        if self.islands:
            self.islands.launch()
            self.islands.keep()
        self._launch_faces("finish_faces")
        self._launch("finish_contact", self.grid)
        if self.islands:
            self.islands.know(self.memory["values"])
            self.islands.keep_ties()

    def _solve_and_search(self, solve: NDArray[Any]) -> None:
        self._solver.solve_contact(self.memory["contact_b"], solve)
        self._launch_faces("face_search", "sweep_faces")
        self._launch("contact_search", self.grid)

    def known(self, values: Float64) -> Float64:
        """Returns a copy of the values of A of a step that has begun, with the contacts that a factor is to know."""
        if self.islands:
            self.islands.start()
        out = values.copy()
        if len(self._surface):
            out[self._surface] = self.memory["known"].get()
        if self.faces:
            self.faces.known(out)
        if not self.islands:
            return out
        copy = self._gpu.cp.asarray(out.astype(self._solver.real))
        self.islands.know(copy)
        with_pairs: Float64 = copy.get().astype(np.float64)
        return with_pairs
