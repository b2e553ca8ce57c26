# SPDX-License-Identifier: MIT
"""Bodies that touch each other, or are tied, on a GPU (island_state.cuh): memory and launches of detection and of the
solves."""

from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int32
from sim_server.backends.contact import MOST_MODES, Contact, Surfaces
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.cupy_types import DeviceArray, KernelFunction
from sim_server.backends.gpu.device import Gpu, compiled, options, own_headers
from sim_server.backends.gpu.energies import node_chunks
from sim_server.backends.gpu.faces import DEFINED, FaceRows
from sim_server.backends.gpu.solver import PcgSolver
from sim_server.backends.gpu.state import device_array, device_arrays
from sim_server.backends.gpu.tie_arguments import tie_arguments
from sim_server.backends.state import StateArray

PAIRS, ISLAND = Declarations("backends/gpu/pairs.cu"), Declarations("backends/gpu/island.cu")
TIES = Declarations("backends/gpu/ties.cu")
ISLAND_ARGUMENTS = ISLAND.dtype("IslandArguments")
SIZES = {name: ISLAND.dtype(name).itemsize for name in ("IslandState", "IslandRow", "Box", "EdgeWings", "PassChoice")}
TALLY = ISLAND.dtype("Tally")
MOST_HELD: int = ISLAND.constant("MOST_HELD")
MODES, CG_SUMS, BASE_SUMS = (ISLAND.constant(name) for name in ("MODES", "CG_SUMS", "BASE_SUMS"))
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
ROWS = ("corner", "weight", "obstacle", "normal", "gap", "entry", "stiffness", "friction", "thickness",
        "hardening", "force",
        "traction", "body_start")  # fmt: skip


PairsTold = tuple[NDArray[Any], NDArray[Any]]
"""What bodies exert on each other: (capacity, bodies, most) of PAIR_SUM; (capacity, bodies) how many each has."""


class Graphs(Protocol):
    """A device whose graphs have branches and loops (cuda.CudaDevice)."""

    def branch(self, flag: DeviceArray) -> AbstractContextManager[None]:
        """What is launched inside runs only if `flag` (1,) is not 0."""
        ...

    def repeat(self, flag: DeviceArray) -> AbstractContextManager[None]:
        """What is launched inside runs as long as `flag` (1,) is not 0."""
        ...


def tree_heights(surfaces: Surfaces) -> Int32:
    """Returns how high each box is over its triangles, (tree,)."""
    child = surfaces.tree_child
    height = np.zeros(len(child), np.int32)
    for k in range(len(child) - 1, -1, -1):  # children come after their parents
        if child[k, 0] >= 0:
            height[k] = 1 + max(height[child[k, 0]], height[child[k, 1]])
    return height


def leaves_before(surfaces: Surfaces) -> Int32:
    """Returns the number of boxes of one triangle before each body's, (bodies + 1,)."""
    counted = np.concatenate([[0], np.cumsum(surfaces.tree_child[:, 0] < 0)])
    return counted[surfaces.tree_start].astype(np.int32)


def own_numbers(surfaces: Surfaces) -> list[Int32]:
    """Returns what bodies need to touch themselves, as own_numbers of island_state.cuh has it; else nothing."""
    if not (own := surfaces.own):
        return []
    return [np.array([surfaces.between, len(own.near_start)], np.int32), own.near_start, own.near_node]


def bodies_of_rows(contact: Contact) -> Int32:
    """Returns the body of each row but those of ties, (rows,)."""

    def of(start: Int32) -> Int32:
        return np.repeat(np.arange(len(start) - 1, dtype=np.int32), np.diff(start))

    faces = of(contact.faces.start) if contact.faces else np.zeros(0, np.int32)
    nodes = of(contact.body_start)
    return np.concatenate([nodes, faces, *([nodes, of(contact.surfaces.edge_start)] if contact.surfaces else [])])


class IslandPasses:
    """Launches detection between bodies, and the solves of bodies that touch each other or have attachments or springs.

    contact: rows, and options; its `surfaces`, its `ties` or both are there
    ranges: nodes [first, last) of each body
    arrays: host arrays by name
    shared: arrays and arguments of contact.cu: memory by name, params, chunks
    threads: of a thread block
    broken: host memory (ties,) of int32 that the steps write to: steps completed when a tie broke
    faces: rows of triangles; None: there are none
    told: host memory that the steps write to, of bodies that touch each other

    Tests run its kernels with what it keeps: params (arguments of all kernels), memory (arrays by name), tally,
    pivots (steps of an inversion), product_grid (thread blocks of the product with A), vertex_grid, edge_grid (of
    detection).
    """

    def __init__(
        self, gpu: Gpu, device: Graphs, contact: Contact, ranges: Sequence[tuple[int, int]],
        arrays: Mapping[str, NDArray[Any]], solver: PcgSolver, params: NDArray[Any], chunks: NDArray[Any], threads: int,
        broken: Int32, faces: FaceRows | None, told: PairsTold | None,
    ):  # fmt: skip
        surfaces, ties, ints, doubles = contact.surfaces, contact.ties, np.int32, np.float64
        self._touching, self._ties = surfaces is not None, ties
        own = surfaces.own if surfaces else None
        self._singles = bool(ties or own)  # a body alone may be an island
        cp, bodies, rows, nodes = gpu.cp, len(ranges), len(contact.obstacle), len(arrays["x"])
        self._device, self._solver, self._threads, self._bodies = device, solver, threads, bodies
        sites, edges = int(contact.body_start[-1]) // 2, len(surfaces.edge) if surfaces else 0
        self._grid, self.vertex_grid, self.edge_grid = len(chunks), -(-sites // (threads // 32)), -(-edges // threads)
        self._faces = faces
        free = np.array([bool((contact.free[first:last] > 0).all()) for first, last in ranges], np.int32)
        most = min(MODES * bodies, MOST_MODES)
        self.pivots = min(int(free.sum()), most // MODES)
        product_chunks = node_chunks(np.array([first for first, _ in ranges] + [nodes], ints), threads // 3)
        self.product_grid = len(product_chunks)
        heights, first = np.zeros(1, ints), np.searchsorted(chunks["body"], np.arange(bodies + 1)).astype(np.int32)
        real = solver.real
        tied = len(ties.corner) if ties else 0
        pairs = int(contact.body_start[-1]) + 2 * edges + tied  # and ties
        row_body = bodies_of_rows(contact)
        self.tally = cp.zeros(TALLY.itemsize // 4, ints)
        places = MOST_HELD * (sites + edges)
        sizes = {
            "near": bodies, "was_near": bodies, "touched": 2 * bodies, "bad": bodies, "label": bodies,
            "island_of": bodies, "mode": bodies, "island_start": bodies + 1, "island": bodies, "free_body": bodies,
            "own_row": rows + (0 if surfaces else 2 * sites), "own_rows": bodies, "pair_rows": bodies,
            "pair_list": 3 * pairs, "count": nodes, "start": nodes, "cursor": nodes, "entry": 4 * pairs,
            "coarse_well": bodies, "held_list": places, "held_count": bodies,
        }  # fmt: skip
        vectors = ("left", "r0", "r", "x", "p", "q", "z", "az", "solution_product")
        numbers = {name: 3 * nodes for name in vectors} | {
            "earliest": bodies, "inverse": 9 * nodes, "modes": 3 * MODES * nodes, "chunk_sums": CG_SUMS * len(chunks),
            "coarse_sums": MODES * len(chunks), "base_sums": BASE_SUMS * len(chunks), "row_sums": 2 * bodies,
            "coarse_a": bodies * MODES * most, "coarse_b": bodies * MODES * most, "coefficient": MODES * bodies,
        }  # fmt: skip
        if solver.errors:
            numbers |= {"before": 3 * nodes, "peaks": 2 * len(chunks)}
        structs = {"state": ("IslandState", bodies), "row": ("IslandRow", rows), "choice": ("PassChoice", bodies)}
        self.memory: dict[str, DeviceArray] = {name: cp.zeros(size, ints) for name, size in sizes.items()}
        self.memory |= {name: cp.zeros(size, doubles) for name, size in numbers.items()}
        self.memory |= {name: cp.zeros(SIZES[kind] * count, np.uint8) for name, (kind, count) in structs.items()}
        if solver.errors:
            self.memory["errors"] = cp.zeros(ISLAND.constant("ERROR_BYTES") * bodies, np.uint8)
        self.memory |= {
            "tally": self.tally, "unheld": cp.asarray(free), "chunk_first": cp.asarray(first),
            "finished_chunks": cp.zeros(bodies, np.uint32),
            "product_chunks": cp.asarray(product_chunks.view(ints)), "ends": cp.zeros((nodes, 3), real),
            "ways": cp.zeros((nodes, 3), real), "none": cp.zeros(3),
            "row_start": gpu.twin(arrays["row_start"]), "columns": gpu.twin(arrays["columns"]),
            "row_body": cp.asarray(row_body), "dropped": gpu.twin(contact.dropped, dtype=contact.dropped.dtype),
        }  # fmt: skip
        if surfaces:
            heights = tree_heights(surfaces)
            held = np.zeros(places, ISLAND.dtype("HeldPlace"))
            held["other"] = -1
            self.memory |= {
                "leaf": cp.asarray(np.flatnonzero(surfaces.tree_child[:, 0] < 0).astype(ints)),
                "leaf_start": cp.asarray(np.concatenate([leaves_before(surfaces), *own_numbers(surfaces)])),
                "tree_height": cp.asarray(heights),
                "edge_body": cp.asarray(row_body[surfaces.edge_start[0] : surfaces.edge_start[-1] : 2].copy()),
                "gravity": gpu.twin(surfaces.gravity, dtype=surfaces.gravity.dtype),
                "held": cp.asarray(held.view(np.uint8)), "mass": gpu.twin(contact.mass),
            }  # fmt: skip
        self._pair_sums, self._pair_contacts = cp.zeros(len(chunks)), cp.zeros(bodies, ints)
        self._pair_clipped = cp.zeros(bodies, ints)
        params["pair_clipped"] = self._pair_clipped.data.ptr
        params["island_of"], params["alone"] = self.memory["island_of"].data.ptr, self.flag("alone").data.ptr
        params["pair_sums"], params["pair_contacts"] = self._pair_sums.data.ptr, self._pair_contacts.data.ptr
        self.params = self._arguments(gpu, contact, surfaces, params)
        self.params["bodies"], self.params["bodies_count"] = solver.bodies_device, bodies
        self.params["most_modes"], self.params["passes"] = most, contact.passes
        self.params["edges"] = edges
        self.params["most_chunks"], self.params["highest_tree"] = np.diff(first).max(), heights.max()
        self.params["ties"]["first"] = rows - tied
        self._tie_state: list[StateArray] = []
        if ties:
            self._tie_memory = tie_arguments(gpu, ties, nodes, broken, self.params)
            named = {name: self._tie_memory[name] for name in ("stiffness", "force", "broken", "start_force", "slope")}
            self._tie_state = [device_array(f"engine.ties.{k}", a, ties.rows, resets=True) for k, a in named.items()]
        if told:
            self.params["told"], self.params["told_count"] = (array.ctypes.data for array in told)
            self.params["most_told"] = told[0].shape[2]
        self._kernels: dict[str, KernelFunction] = {}
        texts = [(PAIRS, "pairs.cu", DETECTION), (ISLAND, "island.cu", (*SOLVE, *(SWEEP_OF_FACES if faces else ())))]
        texts += [(TIES, "ties.cu", KERNELS_OF_TIES)] if ties else []
        for text, name, kernels in texts:
            defined = (*([DEFINED] if faces else []), *(["-DTIES"] if ties else []), *([OWN_SURFACES] if own else []))
            given = (*options(gpu.types), *own_headers(), *defined, *(["-DERRORS"] if solver.errors else []))
            module = cp.RawModule(code=text.checked(), options=given, backend="nvrtc")
            self._kernels |= {kernel: compiled(name, module, kernel) for kernel in kernels}

    def _arguments(
        self, gpu: Gpu, contact: Contact, surfaces: Surfaces | None, contact_params: NDArray[Any]
    ) -> NDArray[Any]:
        """Returns the arguments of all kernels."""
        params: Any = np.zeros((), ISLAND_ARGUMENTS)
        params["c"] = contact_params
        for name, array in self.memory.items():
            params[name] = array.data.ptr
        tables, start = {name: getattr(contact, name) for name in ROWS}, contact.body_start
        of_node, tied = int(start[-1]), len(contact.ties.corner) if contact.ties else 0
        params["t"]["bodies"], params["t"]["pair_first"] = self._bodies, len(contact.obstacle) - tied
        if surfaces:
            params["t"]["pair_first"] = surfaces.edge_start[0] - of_node
            tables |= {name: getattr(surfaces, name) for name in ("site_body", "node_site", "triangle", "tree_start",
                                                                  "tree_child")}  # fmt: skip
            tables["pair_friction"], tables["body_thickness"] = surfaces.friction, surfaces.thickness
        else:
            tables["site_body"] = np.repeat(np.arange(self._bodies, dtype=np.int32), np.diff(start) // 2)
        for name, host in tables.items():
            params["t"][name] = gpu.twin(host, dtype=host.dtype).data.ptr
        zeros = gpu.cp.zeros
        self._boxes = {"tree_box": len(surfaces.tree_child), "body_box": self._bodies} if surfaces else {}
        self._box_memory = {name: zeros(SIZES["Box"] * count, np.uint8) for name, count in self._boxes.items()}
        for name, array in self._box_memory.items():
            params["t"][name] = array.data.ptr
        params["t"]["near"] = self.memory["near"].data.ptr
        self._edge_memory: list[DeviceArray] = []
        if surfaces:
            self._edge_memory = self._edge_arguments(gpu, surfaces, params)
        return params  # type: ignore[no-any-return]

    @staticmethod
    def _edge_arguments(gpu: Gpu, surfaces: Surfaces, params: Any) -> list[DeviceArray]:
        """Sets the tables of edges; returns memory that has to stay."""
        edges: dict[str, NDArray[Any]] = {
            "start": surfaces.edge_start, "edge": surfaces.edge, "opposite": surfaces.opposite,
            "of_triangle": surfaces.triangle_edge, "length": surfaces.edge_length,
        }  # fmt: skip
        for name, host in edges.items():
            params["e"][name] = gpu.twin(host, dtype=host.dtype).data.ptr
        count = max(len(surfaces.edge), 1)
        memory = [gpu.cp.zeros(count * SIZES["EdgeWings"], np.uint8), gpu.cp.zeros(2 * count, np.int32)]
        params["e"]["wings"], params["e"]["facing"] = (array.data.ptr for array in memory)
        return memory

    def state(self) -> list[StateArray]:
        """Returns what steps carry on."""
        names = ("near", "was_near", "touched", "state", "row", "choice", "held", "held_list", "held_count")
        found = device_arrays("engine.islands", self.memory, *names)
        found += [device_array(f"engine.edges.{k}", array) for k, array in enumerate(self._edge_memory)]
        return found + self._tie_state

    def flag(self, name: str) -> DeviceArray:
        """Returns a number of the tally, (1,)."""
        at = TALLY.fields[name][1] // 4  # type: ignore[index]
        found: DeviceArray = self.tally[at : at + 1]
        return found

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
        return self._bodies if self._singles else max(self._bodies // 2, 1)

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
