# SPDX-License-Identifier: MIT
"""What the kernels of bodies that touch each other, or are tied, work with on a GPU (island_state.cuh): memory and
arguments."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int32
from sim_server.backends.contact import MOST_MODES, Contact, Surfaces
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.cupy_types import DeviceArray
from sim_server.backends.gpu.device import Gpu
from sim_server.backends.gpu.energies import node_chunks
from sim_server.backends.gpu.faces import FaceRows
from sim_server.backends.gpu.host_results import ContactResults
from sim_server.backends.gpu.solver import PcgSolver
from sim_server.backends.gpu.state import device_array, device_arrays
from sim_server.backends.gpu.tie_arguments import tie_arguments
from sim_server.backends.state import StateArray

ISLAND = Declarations("backends/gpu/island.cu")
ISLAND_ARGUMENTS = ISLAND.dtype("IslandArguments")
SIZES = {name: ISLAND.dtype(name).itemsize for name in ("IslandState", "IslandRow", "Box", "EdgeWings", "PassChoice")}
TALLY = ISLAND.dtype("Tally")
MOST_HELD: int = ISLAND.constant("MOST_HELD")
MODES: int = ISLAND.constant("MODES")
CG_SUMS, BASE_SUMS = ISLAND.constant("CG_SUMS"), ISLAND.constant("BASE_SUMS")
ROWS = ("corner", "weight", "obstacle", "normal", "gap", "entry", "stiffness", "friction", "thickness",
        "hardening", "force",
        "traction", "body_start")  # fmt: skip


@dataclass(frozen=True)
class SharedContact:
    """What the kernels of islands share with those of contact.cu.

    params: CONTACT_ARGUMENTS. chunks: nodes of each thread block over nodes. threads: of a thread block
    faces: rows of triangles; None: there are none
    """

    params: NDArray[Any]
    chunks: NDArray[Any]
    threads: int
    faces: FaceRows | None


@dataclass(frozen=True)
class IslandSizes:
    """Numbers of what islands consist of.

    rows: of contact and ties. sites: nodes of surfaces. edges: of surfaces. ties: attachments and springs
    chunks: thread blocks over nodes
    """

    bodies: int
    nodes: int
    rows: int
    sites: int
    edges: int
    ties: int
    chunks: int

    @property
    def most_modes(self) -> int:
        """Modes of the coarse space of an island, at most."""
        return min(MODES * self.bodies, MOST_MODES)

    @property
    def pairs(self) -> int:
        """Rows between bodies, and those of ties."""
        return 2 * self.sites + 2 * self.edges + self.ties

    @property
    def held(self) -> int:
        """Places where bodies are held apart."""
        return MOST_HELD * (self.sites + self.edges)

    def integers(self, touching: bool) -> dict[str, int]:
        """Returns the lengths of arrays of int32. touching: whether bodies touch each other"""
        bodies, nodes, pairs = self.bodies, self.nodes, self.pairs
        return {
            "near": bodies, "was_near": bodies, "touched": 2 * bodies, "bad": bodies, "label": bodies,
            "island_of": bodies, "mode": bodies, "island_start": bodies + 1, "island": bodies, "free_body": bodies,
            "own_row": self.rows + (0 if touching else 2 * self.sites), "own_rows": bodies, "pair_rows": bodies,
            "pair_list": 3 * pairs, "count": nodes, "start": nodes, "cursor": nodes, "entry": 4 * pairs,
            "coarse_well": bodies, "held_list": self.held, "held_count": bodies,
        }  # fmt: skip

    def reals(self, errors: bool) -> dict[str, int]:
        """Returns the lengths of arrays of float64. errors: whether solves estimate the errors of positions"""
        bodies, nodes, chunks = self.bodies, self.nodes, self.chunks
        vectors = ("left", "r0", "r", "x", "p", "q", "z", "az", "solution_product")
        found = {name: 3 * nodes for name in vectors} | {
            "earliest": bodies, "inverse": 9 * nodes, "modes": 3 * MODES * nodes, "chunk_sums": CG_SUMS * chunks,
            "coarse_sums": MODES * chunks, "base_sums": BASE_SUMS * chunks, "row_sums": 2 * bodies,
            "coarse_a": bodies * MODES * self.most_modes, "coarse_b": bodies * MODES * self.most_modes,
            "coefficient": MODES * bodies,
        }  # fmt: skip
        return found | ({"before": 3 * nodes, "peaks": 2 * chunks} if errors else {})

    def structs(self, errors: bool) -> dict[str, int]:
        """Returns the bytes of arrays of structs."""
        found = {
            "state": SIZES["IslandState"] * self.bodies, "row": SIZES["IslandRow"] * self.rows,
            "choice": SIZES["PassChoice"] * self.bodies,
        }  # fmt: skip
        return found | ({"errors": ISLAND.constant("ERROR_BYTES") * self.bodies} if errors else {})


class IslandMemory:
    """Memory and arguments of the kernels of islands.

    contact: rows, and options; its `surfaces`, its `ties` or both are there
    ranges: nodes [first, last) of each body
    arrays: host arrays by name
    shared: what contact.cu has; its arguments get what it needs of islands
    results: memory of the host that the steps write to

    arrays: on the device, by name. tally: numbers that decide what is launched. params: ISLAND_ARGUMENTS
    unheld: (bodies,) 1: no node is fixed. product_grid: thread blocks of the product with A
    """

    def __init__(
        self, gpu: Gpu, contact: Contact, ranges: Sequence[tuple[int, int]], arrays: Mapping[str, NDArray[Any]],
        solver: PcgSolver, shared: SharedContact, results: ContactResults,
    ):  # fmt: skip
        self._gpu, self._contact, self._arrays, self._solver, self._shared = gpu, contact, arrays, solver, shared
        surfaces, ties = contact.surfaces, contact.ties
        self.sizes = IslandSizes(
            len(ranges), len(arrays["x"]), len(contact.obstacle), int(contact.body_start[-1]) // 2,
            len(surfaces.edge) if surfaces else 0, len(ties.corner) if ties else 0, len(shared.chunks),
        )  # fmt: skip
        self.tally = gpu.cp.zeros(TALLY.itemsize // 4, np.int32)
        self.unheld = np.array([bool((contact.free[first:last] > 0).all()) for first, last in ranges], np.int32)
        self._body_starts = np.array([first for first, _ in ranges] + [self.sizes.nodes], np.int32)
        self.arrays = self._working_arrays() | self._tables()
        if surfaces:
            self.arrays |= self._surface_arrays(surfaces)
        self._share()
        self.params = self._arguments()
        if ties:
            self._ties = tie_arguments(gpu, ties, self.sizes.nodes, results.broken, self.params)
        if results.pairs:
            self.params["told"], self.params["told_count"] = (array.ctypes.data for array in results.pairs)
            self.params["most_told"] = results.pairs[0].shape[2]

    def flag(self, name: str) -> DeviceArray:
        """Returns a number of the tally, (1,)."""
        at = TALLY.fields[name][1] // 4  # type: ignore[index]
        found: DeviceArray = self.tally[at : at + 1]
        return found

    def state(self) -> list[StateArray]:
        """Returns what steps carry on."""
        names = ("near", "was_near", "touched", "state", "row", "choice", "held", "held_list", "held_count")
        found = device_arrays("engine.islands", self.arrays, *names)
        found += [device_array(f"engine.edges.{k}", array) for k, array in enumerate(self._edges)]
        if ties := self._contact.ties:
            kept = {name: self._ties[name] for name in ("stiffness", "force", "broken", "start_force", "slope")}
            found += [device_array(f"engine.ties.{k}", a, ties.rows, resets=True) for k, a in kept.items()]
        return found

    def _working_arrays(self) -> dict[str, DeviceArray]:
        """Allocates what kernels alone write and read."""
        zeros, sizes, errors, nodes = self._gpu.cp.zeros, self.sizes, self._solver.errors, self.sizes.nodes
        integers = sizes.integers(self._contact.surfaces is not None)
        found = {name: zeros(size, np.int32) for name, size in integers.items()}
        found |= {name: zeros(size, np.float64) for name, size in sizes.reals(errors).items()}
        found |= {name: zeros(size, np.uint8) for name, size in sizes.structs(errors).items()}
        return found | {
            "finished_chunks": zeros(sizes.bodies, np.uint32), "none": zeros(3), "tally": self.tally,
            "ends": zeros((nodes, 3), self._solver.real), "ways": zeros((nodes, 3), self._solver.real),
        }  # fmt: skip

    def _tables(self) -> dict[str, DeviceArray]:
        """Copies what tells bodies, rows and nodes apart to the device."""
        gpu, contact, arrays, asarray = self._gpu, self._contact, self._arrays, self._gpu.cp.asarray
        self._row_body = bodies_of_rows(contact)
        bodies = np.arange(self.sizes.bodies + 1)
        self._chunk_first = np.searchsorted(self._shared.chunks["body"], bodies).astype(np.int32)
        product_chunks = node_chunks(self._body_starts, self._shared.threads // 3)
        self.product_grid = len(product_chunks)
        return {
            "unheld": asarray(self.unheld), "chunk_first": asarray(self._chunk_first),
            "product_chunks": asarray(product_chunks.view(np.int32)), "row_body": asarray(self._row_body),
            "row_start": gpu.twin(arrays["row_start"]), "columns": gpu.twin(arrays["columns"]),
            "dropped": gpu.twin(contact.dropped, dtype=contact.dropped.dtype),
        }  # fmt: skip

    def _surface_arrays(self, surfaces: Surfaces) -> dict[str, DeviceArray]:
        """Copies what detection between surfaces needs to the device."""
        gpu, asarray = self._gpu, self._gpu.cp.asarray
        first, last = surfaces.edge_start[0], surfaces.edge_start[-1]  # rows of edges, two each
        self._tree_heights = tree_heights(surfaces)
        held = np.zeros(self.sizes.held, ISLAND.dtype("HeldPlace"))
        held["other"] = -1
        return {
            "leaf": asarray(np.flatnonzero(surfaces.tree_child[:, 0] < 0).astype(np.int32)),
            "leaf_start": asarray(np.concatenate([leaves_before(surfaces), *own_numbers(surfaces)])),
            "tree_height": asarray(self._tree_heights),
            "edge_body": asarray(self._row_body[first:last:2].copy()),
            "gravity": gpu.twin(surfaces.gravity, dtype=surfaces.gravity.dtype),
            "held": asarray(held.view(np.uint8)), "mass": gpu.twin(self._contact.mass),
        }  # fmt: skip

    def _share(self) -> None:
        """Gives the kernels of contact.cu what they need of islands."""
        zeros, bodies, params = self._gpu.cp.zeros, self.sizes.bodies, self._shared.params
        self._for_contact: dict[str, DeviceArray] = {
            "pair_sums": zeros(self.sizes.chunks), "pair_contacts": zeros(bodies, np.int32),
            "pair_clipped": zeros(bodies, np.int32), "island_of": self.arrays["island_of"], "alone": self.flag("alone"),
        }  # fmt: skip
        for name, array in self._for_contact.items():
            params[name] = array.data.ptr

    def _arguments(self) -> NDArray[Any]:
        """Returns the arguments of all kernels, but for ties."""
        params: Any = np.zeros((), ISLAND_ARGUMENTS)
        sizes, contact, surfaces = self.sizes, self._contact, self._contact.surfaces
        params["c"] = self._shared.params
        for name, array in self.arrays.items():
            params[name] = array.data.ptr
        self._set_tables(params["t"])
        self._edges = self._edge_arguments(surfaces, params["e"]) if surfaces else list[DeviceArray]()
        params["bodies"], params["bodies_count"] = self._solver.bodies_device, sizes.bodies
        params["most_modes"], params["passes"], params["edges"] = sizes.most_modes, contact.passes, sizes.edges
        params["most_chunks"] = np.diff(self._chunk_first).max()
        params["highest_tree"] = self._tree_heights.max() if surfaces else 0
        params["ties"]["first"] = sizes.rows - sizes.ties
        return params  # type: ignore[no-any-return]

    def _set_tables(self, tables: Any) -> None:
        """Sets the tables of rows and surfaces (SurfaceTables)."""
        contact, surfaces, sizes = self._contact, self._contact.surfaces, self.sizes
        hosts = {name: getattr(contact, name) for name in ROWS}
        boxes: dict[str, int] = {}
        tables["bodies"], tables["pair_first"] = sizes.bodies, sizes.rows - sizes.ties
        if surfaces:
            tables["pair_first"] = surfaces.edge_start[0] - 2 * sizes.sites
            names = ("site_body", "node_site", "triangle", "tree_start", "tree_child")
            hosts |= {name: getattr(surfaces, name) for name in names}
            hosts["pair_friction"], hosts["body_thickness"] = surfaces.friction, surfaces.thickness
            boxes = {"tree_box": len(surfaces.tree_child), "body_box": sizes.bodies}
        else:
            bodies = np.arange(sizes.bodies, dtype=np.int32)
            hosts["site_body"] = np.repeat(bodies, np.diff(contact.body_start) // 2)
        for name, host in hosts.items():
            tables[name] = self._gpu.twin(host, dtype=host.dtype).data.ptr
        self._boxes = {name: self._gpu.cp.zeros(SIZES["Box"] * count, np.uint8) for name, count in boxes.items()}
        for name, array in self._boxes.items():
            tables[name] = array.data.ptr
        tables["near"] = self.arrays["near"].data.ptr

    def _edge_arguments(self, surfaces: Surfaces, edges: Any) -> list[DeviceArray]:
        """Sets the tables of edges (EdgeTables); returns memory that has to stay."""
        hosts: dict[str, NDArray[Any]] = {
            "start": surfaces.edge_start, "edge": surfaces.edge, "opposite": surfaces.opposite,
            "of_triangle": surfaces.triangle_edge, "length": surfaces.edge_length,
        }  # fmt: skip
        for name, host in hosts.items():
            edges[name] = self._gpu.twin(host, dtype=host.dtype).data.ptr
        count, zeros = max(len(surfaces.edge), 1), self._gpu.cp.zeros
        memory = [zeros(count * SIZES["EdgeWings"], np.uint8), zeros(2 * count, np.int32)]
        edges["wings"], edges["facing"] = (array.data.ptr for array in memory)
        return memory


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
