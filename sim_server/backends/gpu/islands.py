# SPDX-License-Identifier: MIT
"""Bodies that touch each other, or are tied, on a GPU (island_state.cuh): launches of detection and of the solves.
Their memory: island_memory.py."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.contact import Contact
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.cupy_types import DeviceArray, KernelFunction
from sim_server.backends.gpu.device import Gpu, compiled, options, own_headers
from sim_server.backends.gpu.faces import DEFINED
from sim_server.backends.gpu.host_results import ContactResults
from sim_server.backends.gpu.island_memory import ISLAND, MODES, IslandMemory, SharedContact
from sim_server.backends.gpu.solver import PcgSolver
from sim_server.backends.state import StateArray

PAIRS, TIES = Declarations("backends/gpu/pairs.cu"), Declarations("backends/gpu/ties.cu")
LISTING, SEARCH = PAIRS.constant("LISTING_THREADS"), ISLAND.constant("SEARCH_THREADS")  # of a thread block
WARM_START, ZERO_START, LAW_AT_START, LAW = ISLAND.enumeration("Evaluation").values()
KERNELS_OF_TIES = ("begin_ties", "bind_edges", "keep_ties")
OWN_SURFACES = "-DOWN_SURFACES"  # in texts of scenes whose bodies touch themselves
SWEEP_OF_FACES = ("sweep_island_faces",)
DETECTION = (
    "pair_boxes", "pair_trees", "pair_sites", "pair_edges", "pair_sweep", "edge_sweep", "end_sweep", "look_at_bodies",
    "list_island_rows", "find_islands", "place_entries", "fill_entries",
)  # fmt: skip
SOLVE = (
    "island_start", "island_law", "island_balance", "island_decide", "island_prepare", "coarse_matrix",
    "invert_coarse", "island_update", "island_multiply", "island_product", "coarse_solve", "island_finish",
    "island_residual", "island_search", "island_advance", "island_settle", "know_pairs", "keep_pairs",
    "pair_work",
)  # fmt: skip


class Graphs(Protocol):
    """A device whose graphs have branches and loops (cuda.CudaDevice)."""

    def branch(self, flag: DeviceArray) -> AbstractContextManager[None]:
        """What is launched inside runs only if `flag` (1,) is not 0."""
        ...

    def repeat(self, flag: DeviceArray) -> AbstractContextManager[None]:
        """What is launched inside runs as long as `flag` (1,) is not 0."""
        ...


class IslandPasses:
    """Launches detection between bodies, and the solves of bodies that touch each other or have attachments or springs.

    contact: rows, and options; its `surfaces`, its `ties` or both are there
    ranges: nodes [first, last) of each body
    arrays: host arrays by name
    shared: what they share with contact.cu
    results: memory of the host that the steps write to

    Tests run its kernels with what it keeps: params (arguments of all kernels), memory (arrays by name), tally,
    pivots (steps of an inversion), product_grid (thread blocks of the product with A), vertex_grid, edge_grid (of
    detection).
    """

    def __init__(
        self, gpu: Gpu, device: Graphs, contact: Contact, ranges: Sequence[tuple[int, int]],
        arrays: Mapping[str, NDArray[Any]], solver: PcgSolver, shared: SharedContact, results: ContactResults,
    ):  # fmt: skip
        surfaces, threads = contact.surfaces, shared.threads
        self._touching, self._ties, self._faces = surfaces is not None, contact.ties, shared.faces
        self._own = bool(surfaces and surfaces.own)  # bodies touch themselves
        self._device, self._solver, self._threads, self._bodies = device, solver, threads, len(ranges)
        made = self._island_memory = IslandMemory(gpu, contact, ranges, arrays, solver, shared, results)
        self.params, self.memory, self.tally, self.flag = made.params, made.arrays, made.tally, made.flag
        self._grid, self.product_grid = made.sizes.chunks, made.product_grid
        self.vertex_grid, self.edge_grid = -(-made.sizes.sites // (threads // 32)), -(-made.sizes.edges // threads)
        self.pivots = min(int(made.unheld.sum()), made.sizes.most_modes // MODES)
        self._kernels = self._compiled(gpu)

    def _compiled(self, gpu: Gpu) -> dict[str, KernelFunction]:
        """Compiles the kernels of the scene; returns them by name."""
        faces, own = self._faces is not None, self._own
        texts = [(PAIRS, "pairs.cu", DETECTION), (ISLAND, "island.cu", (*SOLVE, *(SWEEP_OF_FACES if faces else ())))]
        texts += [(TIES, "ties.cu", KERNELS_OF_TIES)] if self._ties else []
        wanted = {DEFINED: faces, "-DTIES": self._ties, OWN_SURFACES: own, "-DERRORS": self._solver.errors}
        flags = (*options(gpu.types), *own_headers(), *(name for name, there in wanted.items() if there))
        found: dict[str, KernelFunction] = {}
        for text, name, kernels in texts:
            module = gpu.cp.RawModule(code=text.checked(), options=flags, backend="nvrtc")
            found |= {kernel: compiled(name, module, kernel) for kernel in kernels}
        return found

    def state(self) -> list[StateArray]:
        """Returns what steps carry on."""
        return self._island_memory.state()

    # --- launches -----------------------------------------------------------------------------------------------

    def _launch(self, kernel: str, blocks: int, *arguments: Any) -> None:
        threads = {"find_islands": LISTING, "island_search": SEARCH, "end_sweep": LISTING}.get(kernel, self._threads)
        given = (np.int32(x) if isinstance(x, int) else x for x in arguments)
        self._kernels[kernel]((blocks,), (threads,), (self.params, *given))

    def _nodes(self, *kernels: str, what: tuple[int, ...] = ()) -> None:
        for kernel in kernels:
            self._launch(kernel, self._grid, *what)

    def _edges(self, kernel: str) -> None:
        if self.edge_grid:
            self._launch(kernel, self.edge_grid)

    def _each_body(self, *kernels: str, what: tuple[int, ...] = ()) -> None:
        for kernel in kernels:
            self._launch(kernel, self._bodies, *what)

    def detect(self) -> None:
        """Appends detection, once a step: it turns what rows remember with their normals."""
        if not self._touching:
            return
        self._each_body("pair_boxes", "pair_trees", what=(0,))
        self._launch("pair_sites", self.vertex_grid)
        self._edges("pair_edges")

    def group(self, swept: int = 0) -> None:
        """Appends the search of islands."""
        self._nodes("look_at_bodies")
        self._each_body("list_island_rows", what=(swept,))
        self._launch("find_islands", 1, swept)

    def begin_ties(self) -> None:
        """Appends what attachments and springs do before islands are searched."""
        if self._ties:
            items = max(int(self.params["ties"]["count"]), int(self.params["bound_nodes"]))
            self._launch("begin_ties", -(-items // self._threads))
            self._edges("bind_edges")

    def keep_ties(self) -> None:
        """Appends what they do at the end of a step, after all that moves nodes."""
        if self._ties:
            self._launch("keep_ties", self._ties.tables)

    def launch(self) -> None:
        """Appends all solves of islands, while a graph is captured."""
        with self._device.repeat(self.flag("go")):
            with self._device.branch(self.flag("active")):
                self.start()
                with self._device.repeat(self.flag("active")):
                    self.begin_pass()
                    with self._device.repeat(self.flag("iterating")):
                        self.iterate()
                    self.end_pass()
            if self._touching:
                self._each_body("pair_boxes", "pair_trees", what=(1,))
                self._launch("pair_sweep", self.vertex_grid)
                self._edges("edge_sweep")
            self._launch("end_sweep", 1)
            with self._device.branch(self.flag("again")):
                self.group(1)

    def start(self) -> None:
        """Appends what comes before the first pass of islands."""
        self._nodes("place_entries")
        self._each_body("fill_entries")
        self._nodes("island_start")
        for what in (WARM_START, ZERO_START, LAW_AT_START):
            self._law(what)

    def _law(self, what: int) -> None:
        self._each_body("island_law", what=(what,))
        self._nodes("island_balance", what=(what,))
        self._launch("island_decide", self._most_islands, what)

    @property
    def _most_islands(self) -> int:
        alone = bool(self._ties or self._own)  # a body alone may be an island
        return self._bodies if alone else max(self._bodies // 2, 1)

    def begin_pass(self) -> None:
        """Appends what comes before the iterations of a pass."""
        self._law(LAW)
        self._nodes("island_prepare")
        self._each_body("coarse_matrix")
        for pivot in range(self.pivots):
            self._each_body("invert_coarse", what=(pivot,))

    def iterate(self) -> None:
        """Appends an iteration."""
        self._nodes("island_update")
        self._solver.apply_island_factors(self.params)
        self._multiply(0)
        self._nodes("island_product")
        self._each_body("coarse_solve")
        self._nodes("island_finish")

    def end_pass(self) -> None:
        """Appends what comes after them."""
        self._nodes("island_update")
        self._multiply(1)
        self._nodes("island_residual")
        self._launch("island_search", self._most_islands)
        self._nodes("island_advance")
        if self._faces:
            self._launch("sweep_island_faces", self._faces.grid)
        self._launch("island_settle", self._most_islands)

    def _multiply(self, solution: int) -> None:
        self._launch("island_multiply", self._bodies + self.product_grid, solution)

    def keep(self) -> None:
        """Appends what comes before the end of a step: forces of rows between bodies, and their work."""
        if self._touching:
            self._each_body("keep_pairs")
        self._nodes("pair_work")

    def know(self, values: DeviceArray) -> None:
        """Appends the addition of contacts between bodies, as a factor is to know them, to values of A."""
        self._launch("know_pairs", self._grid, np.uint64(values.data.ptr))
