# SPDX-License-Identifier: MIT
"""The input of contact and its memory, as the loop of a CPU reads them."""

import ctypes as c
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64
from sim_server.backends.contact import MOST_MODES, Contact, OwnSurfaces, Surfaces
from sim_server.backends.cpu import structs
from sim_server.backends.state import StateArray, host_array, memory_of, same_body
from sim_server.backends.ties import Ties


class NativeContact:
    """The input of contact and its memory, attached to a loop. arrays: of the system."""

    def __init__(self, contact: Contact, loop: structs.Loop, arrays: Mapping[str, NDArray[Any]]):
        self._input, obstacles = contact, contact.obstacles
        rows, count, bodies = len(contact.obstacle), len(obstacles.kind), loop.bodies
        self._state = (structs.RowState * max(rows, 1))()
        self._report = (structs.ContactReport * bodies)()
        self._result = (structs.SolveResult * bodies)()
        self._choice = (structs.PassChoice * bodies)()
        self._own: dict[str, NDArray[Any]] = {
            "active": np.zeros(rows, np.int32), "room": np.zeros((9, loop.nodes, 3)),
            "reaction": np.zeros((bodies, count, 6)), "mode": np.zeros(bodies, np.int32),
            "island": np.zeros(bodies, np.int32), "island_start": np.zeros(bodies + 1, np.int32),
            "island_rows": np.zeros(bodies, np.int32), "near": np.zeros(bodies, np.int32),
            "was_near": np.zeros(bodies, np.int32),
            "touched": np.zeros(bodies, np.int32), "used": np.zeros(rows, np.int32),
            "row_body": self._row_body(contact), "node_site": np.full(loop.nodes, -1, np.int32),
        }  # fmt: skip
        sites = contact.body_start[-1] // 2
        self._own["site_body"] = self._own["row_body"][: 2 * sites : 2].copy()
        self._own["node_site"][contact.corner[: 2 * sites : 2, 0]] = np.arange(sites)
        self.native = structs.Contact(
            obstacle_count=count, passes=contact.passes, tolerance=contact.tolerance, dx_dv=contact.dx_dv,
            force_coefficient=contact.force_coefficient, state=c.addressof(self._state), pair_first=-1,
            report=c.addressof(self._report), result=c.addressof(self._result),
            choice=c.addressof(self._choice),
        )  # fmt: skip
        if faces := contact.faces:
            self._own |= {
                "face_start": faces.start, "face": faces.triangle, "face_owns": faces.owns,
                "face_friction": faces.friction, "gravity": faces.gravity,
            }  # fmt: skip
        if contact.surfaces or contact.ties:
            self._join(contact.free, rows, loop)
        if contact.surfaces:
            tied = len(contact.ties.corner) if contact.ties else 0
            first = rows - tied - 2 * len(contact.surfaces.edge) - int(contact.body_start[-1])
            self._touch(contact.surfaces, first, loop)
        if contact.ties:
            self._tie(contact.ties, rows - len(contact.ties.corner), loop.nodes)
        for name in ("kind", "size", "grid", "place", "cells", "begin", "end"):
            setattr(self.native.obstacles, name, getattr(obstacles, name).ctypes.data)
        for name in ("body_start", "corner", "weight", "obstacle", "normal", "gap", "drift", "entry", "stiffness",
                     "friction", "thickness", "hardening", "force", "traction", "predictor", "free", "dropped",
                     "mass"):  # fmt: skip
            setattr(self.native, name, getattr(contact, name).ctypes.data)
        for name, array in self._own.items():
            setattr(self.native, name, array.ctypes.data)
        self.native.rotation = arrays["rotation"].ctypes.data
        loop.contact = c.addressof(self.native)

    def state(self) -> list[StateArray]:
        """Returns what steps carry on beside the rows that launches write."""
        own, count = self._own, len(self._report)
        found = [
            host_array("engine.contact.choice", memory_of(self._choice, count), same_body, resets=False),
            host_array("engine.contact.report", memory_of(self._report, count), same_body),
            host_array("engine.contact.was_near", own["was_near"], same_body),
            host_array("engine.contact.near", own["near"], same_body),
        ]
        rows: dict[str, NDArray[Any]] = {
            "state": memory_of(self._state, len(self._state)), "corner": self._input.corner,
        }  # fmt: skip
        rows |= {"weight": self._input.weight} | {k: own[k] for k in ("facing",) if k in own}
        found += [host_array(f"engine.contact.{k}", array, resets=False) for k, array in rows.items()]
        if self._input.surfaces and self._input.surfaces.own:
            surfaces = self._own_surfaces
            names = ("reference", "strain", "moved", "clear", "edge_clear", "apart", "edges_apart")
            found.append(host_array("engine.own.body", memory_of(self._references, count), same_body))
            found += [host_array(f"engine.own.{name}", surfaces[name], resets=False) for name in names]
        if ties := self._input.ties:
            named: dict[str, NDArray[Any]] = {
                "stiffness": ties.stiffness, "force": ties.force, "broken": ties.broken,
                "start_force": self._ties["start_force"], "slope": self._ties["slope"],
            }  # fmt: skip
            found += [host_array(f"engine.ties.{name}", array, ties.rows) for name, array in named.items()]
        return found

    def surface_nodes(self, body: int) -> int:
        """Returns the number of a body's surface nodes."""
        start = self._input.body_start
        return int(start[body + 1] - start[body]) // 2

    @staticmethod
    def _row_body(contact: Contact) -> NDArray[np.int32]:
        """Returns the body of each row."""
        starts = [contact.body_start]
        starts += [contact.faces.start] if contact.faces else []
        starts += [contact.body_start, contact.surfaces.edge_start] if contact.surfaces else []
        return np.concatenate([np.repeat(np.arange(len(s) - 1, dtype=np.int32), np.diff(s)) for s in starts])

    def _join(self, free: Float64, rows: int, loop: structs.Loop) -> None:
        """Adds what bodies need that are solved as one system."""
        most = min(6 * loop.bodies, MOST_MODES)
        ranges = [(b.first, b.last) for b in c.cast(loop.body, c.POINTER(structs.Body))[: loop.bodies]]
        self._own |= {
            "modes": np.zeros((loop.nodes, 18)), "coarse": np.zeros((most + 4, most)), "lever": np.zeros((rows, 8)),
            "unheld": np.array([bool((free[first:last] > 0).all()) for first, last in ranges], np.int32),
        }  # fmt: skip
        self.native.most_modes = most

    def _tie(self, ties: Ties, first: int, nodes: int) -> None:
        """Adds attachments and springs, whose rows begin at `first`."""
        bodies = len(ties.reaction)
        start = np.searchsorted(ties.body[:, 0], np.arange(bodies + 1)).astype(np.int32)
        n = len(ties.corner)
        self._ties: dict[str, NDArray[Any]] = {
            "start": start, "order": np.argsort(ties.table, kind="stable").astype(np.int32),
            "start_force": np.zeros((n, 3)), "slope": np.zeros((n, 6)), "bound": np.zeros(nodes, np.int32),
        }  # fmt: skip
        named = (
            "body", "obstacle", "table", "point", "kappa", "rest", "breaking", "stiffness", "force", "broken",
            "reaction",
        )  # fmt: skip
        self._ties |= {name: getattr(ties, name) for name in named}
        native = self.native.ties
        native.first, native.count, native.tables = first, n, ties.tables
        native.columns, native.column_first = ties.reaction.shape[1], ties.column
        for name, array in self._ties.items():
            setattr(native, name, array.ctypes.data)

    def _touch(self, surfaces: Surfaces, first: int, loop: structs.Loop) -> None:
        """Adds what bodies need to touch each other. first: row of the first one between bodies."""
        self._boxes = [(structs.Box * max(n, 1))() for n in (len(surfaces.tree_child), loop.bodies)]
        self._wings = (structs.EdgeWings * max(len(surfaces.edge), 1))()
        self._own |= {
            "edge_start": surfaces.edge_start, "edge": surfaces.edge, "edge_opposite": surfaces.opposite,
            "triangle_edge": surfaces.triangle_edge, "edge_length": surfaces.edge_length,
            "body_thickness": surfaces.thickness, "facing": np.full(2 * len(surfaces.edge), -1, np.int32),
            "triangle": surfaces.triangle, "tree_start": surfaces.tree_start,
            "tree_child": surfaces.tree_child, "pair_friction": surfaces.friction, "gravity": surfaces.gravity,
        }  # fmt: skip
        self.native.tree_box, self.native.body_box = map(c.addressof, self._boxes)
        self.native.wings = c.addressof(self._wings)
        self.native.pair_first, self.native.between = first, surfaces.between
        if surfaces.own:
            self._touch_itself(surfaces.own, len(surfaces.site_body), len(surfaces.edge), loop)

    def _touch_itself(self, own: OwnSurfaces, sites: int, edges: int, loop: structs.Loop) -> None:
        """Adds what bodies need to touch themselves."""
        self._references = (structs.OwnReference * loop.bodies)()
        self._own_surfaces: dict[str, NDArray[Any]] = {
            "start": own.start, "node": own.node, "reference": np.zeros((len(own.node), 3)),
            "strain": np.zeros(loop.nodes), "moved": np.zeros(loop.nodes), "clear": np.zeros(sites),
            "edge_clear": np.zeros(edges), "apart": np.zeros(sites), "edges_apart": np.zeros(edges),
        }  # fmt: skip
        native = self.native.own
        for name, array in self._own_surfaces.items():
            setattr(native, name, array.ctypes.data)
        native.near.start, native.near.node = own.near_start.ctypes.data, own.near_node.ctypes.data
        native.body = c.addressof(self._references)
