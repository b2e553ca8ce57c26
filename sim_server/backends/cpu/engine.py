# SPDX-License-Identifier: MIT
"""The native simulation loop as seen from Python: its memory, its mailboxes and what it reports.

`Engine.run` lets go of Python's lock for as long as it runs. Everything else here only puts things into mailboxes or
reads what the loop has left in its rings, and may be called from another thread meanwhile. Layouts: structs.py.
"""

import ctypes as c
import time
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor, FactorPattern
from sim_server.arrays import Float64, Int32, Int64
from sim_server.backends.base import ArrayChange, Capability, CutInput, EngineInput, Launch
from sim_server.backends.central_difference import NODAL as NODAL_OF_SUBSTEPS
from sim_server.backends.central_difference import CentralDifference
from sim_server.backends.compiler import native
from sim_server.backends.contact import Contact, OwnSurfaces, Surfaces
from sim_server.backends.cpu import structs
from sim_server.backends.cpu.device import CpuLaunch
from sim_server.backends.cpu.energies import NativeEnergies
from sim_server.backends.cpu.halving import NativeHalving
from sim_server.backends.cpu.processors import usable_threads
from sim_server.backends.euler_form import EulerForm
from sim_server.backends.newton import Newton
from sim_server.backends.rank_one import RankOne
from sim_server.backends.ring_buffers import Reports
from sim_server.backends.rosenbrock import NODAL, Rosenbrock
from sim_server.backends.state import StateArray, host_array, memory_of, numbers_array, same_body
from sim_server.backends.ties import Ties

Reals = NDArray[np.float64]
SHARED_SIZE = 600  # degrees of freedom from which on the solves of a factor are shared out between threads
HISTORY = 1024  # changes of the diagonal that are remembered, of each body
KNOWN_CONTACTS = 32, 16384  # blocks of contacts that are remembered: of each surface node of a body, and of all at most


@cache
def _library() -> c.CDLL:
    loop, p = c.POINTER(structs.Loop), c.c_void_p
    library = native(
        "backends/cpu/native/loop.cpp",
        {
            "wf_assemble": (None, [loop]), "wf_solve": (None, [loop]), "wf_run": (c.c_int64, [loop, c.c_int64]),
            "wf_wait": (c.c_int32, [loop]), "wf_restart": (None, [loop, c.c_void_p, c.c_int32]),
            "wf_copy_matrix": (None, [loop, c.c_int32, p]), "wf_note_matrix": (None, [loop, c.c_int32]),
            "wf_post_factor": (p, [c.POINTER(structs.Body), p]), "wf_post_binding": (p, [c.POINTER(structs.Launch), p]),
            "wf_post_changes": (p, [loop, p]), "wf_take_changes": (None, [loop]),
            "wf_apply_factor": (None, [c.POINTER(structs.Factor), p, p, p, c.c_int32]),
            "wf_plan": (p, [c.POINTER(structs.Pattern), c.c_int32]), "wf_delete_plan": (None, [p]),
            "wf_precondition": (None, [loop, c.c_int32, p, p, p]),
        },
    )  # fmt: skip
    structs.LOOP.check_sizes(library)
    return library


class NativePattern:
    """The pattern of a factor as native code reads it. threads: shares the solves out between so many, if it can and
    that pays; 0: not at all. Of one body: its solves work in memory that belongs to the pattern."""

    def __init__(self, pattern: FactorPattern, threads: int = 0):
        self.pattern = pattern
        self.native = structs.Pattern(
            size=pattern.size, supernodes=len(pattern.super_start) - 1, permutation=pattern.permutation.ctypes.data,
            super_start=pattern.super_start.ctypes.data, row_start=pattern.row_start.ctypes.data,
            rows=pattern.rows.ctypes.data, value_start=pattern.value_start.ctypes.data,
        )  # fmt: skip
        if threads and pattern.size >= SHARED_SIZE:
            library = _library()
            self.native.plan = library.wf_plan(c.byref(self.native), threads)
            weakref.finalize(self, library.wf_delete_plan, self.native.plan)

    @property
    def is_shared(self) -> bool:
        """True if threads share its solves."""
        return bool(self.native.plan)


KEPT = 16 << 20  # bytes of a factor above which its values are kept instead of copied


class NativeFactor:
    """A factor in memory that native code can apply: to the given values, which are not copied."""

    def __init__(self, pattern: FactorPattern | NativePattern, values: NDArray[Any], step: int = -1):
        self._pattern = pattern if isinstance(pattern, NativePattern) else NativePattern(pattern)
        self.pattern = self._pattern.pattern
        self.values, self._taken = values, False
        self.native = structs.Factor(
            pattern=c.addressof(self._pattern.native), values=values.ctypes.data, step=step, bytes=values.itemsize
        )

    @classmethod
    def empty(cls, pattern: FactorPattern | NativePattern, dtype: np.dtype | type) -> "NativeFactor":
        """Room for a factor, to be filled."""
        full = pattern.pattern if isinstance(pattern, NativePattern) else pattern
        return cls(pattern, np.zeros(full.nonzeros, dtype))

    @property
    def address(self) -> int:
        """Address of the native struct, which a mailbox takes."""
        return c.addressof(self.native)

    def fill(self, values: NDArray[Any], step: int) -> None:
        """Takes the values of L made from the matrix of `step`: copies them, or keeps those of a large factor, which
        would fill the memory once more."""
        if values.nbytes > KEPT or self._taken:  # those that were taken over are not ours to write to
            self.take(values if values.nbytes > KEPT else values.copy(), step)
            return
        self.values[:] = values
        self.native.step = step

    def take(self, values: NDArray[Any], step: int) -> None:
        """Takes over the values, which do not change any more, instead of a copy: that of a large body takes as long as
        many rounds of the service thread."""
        self.values, self._taken = np.ascontiguousarray(values), True
        self.native.values, self.native.step = self.values.ctypes.data, step

    def apply(self, r: Reals, threads: int = 1) -> Reals:
        """P^-1 r, (size,), outside of any step, on so many threads at most. A probe for tests and benchmarks."""
        r = np.ascontiguousarray(r, dtype=np.float64)
        z, work = np.empty_like(r), np.empty(2 * len(r))
        _library().wf_apply_factor(c.byref(self.native), r.ctypes.data, z.ctypes.data, work.ctypes.data, threads)
        return z


@dataclass
class Mailbox:
    """Factor buffers of a body, two of them: one in use, the other waiting or to be filled."""

    buffers: list[NativeFactor]
    pattern: NativePattern | None = None  # of the newest buffer
    waiting: NativeFactor | None = None  # as posted last
    in_use: NativeFactor | None = None  # as far as the mailbox has told


class _NativeRankOne:
    """Parts of A of rank one, attached to a loop."""

    def __init__(self, given: RankOne, rotation: Reals, loop: structs.Loop):
        self._arrays = {**vars(given), "rotation": rotation}
        self.native = structs.RankOne(**{name: array.ctypes.data for name, array in self._arrays.items()})
        loop.rank_one = c.addressof(self.native)


class _NativeNewton:
    """The input of Newton-Raphson and its memory, attached to a loop and its launches.

    late: of each assembling launch, whether a trial can do without it
    """

    def __init__(self, newton: Newton, late: Sequence[bool], loop: structs.Loop, launches: Any):
        self._room = np.zeros((18, len(newton.arrays["mass"])))
        self._search = (structs.Search * loop.bodies)()
        self._arrays, self._late = newton.arrays, np.array(late, np.int32)
        options = newton.options
        limits = structs.Limits(options.linearizations, options.trials, options.tolerance)
        self.native = structs.Newton(most=limits, dx_dv=newton.dx_dv)
        for name, array in {**newton.arrays, "room": self._room, "late": self._late}.items():
            setattr(self.native, name, array.ctypes.data)
        self.native.search = c.addressof(self._search)
        self.native.detect, self.native.detects = newton.detect.start, newton.detect.stop - newton.detect.start
        loop.newton = c.addressof(self.native)
        self._parts = newton.parts
        for launch, part in zip(launches, newton.parts, strict=False):
            launch.parts = None if part is None else part.ctypes.data

    def search_in_contact(self, bodies: int) -> Reals:
        """Adds what searches with contact need; returns the predictor of contact."""
        moved = np.zeros((self._room.shape[1], 3))
        most, entered = np.zeros(bodies, np.int32), np.zeros(bodies, np.int32)
        self._touch: dict[str, NDArray[Any]] = {"moved": moved, "most_touching": most, "entered": entered}
        for name, array in self._touch.items():
            setattr(self.native, name, array.ctypes.data)
        return moved


LISTS = ("first", "again", "end")  # of launches


class _NativeStages:
    """The input of the Rosenbrock-W step and its memory, attached to a loop. number: of each launch by id."""

    def __init__(self, stages: Rosenbrock, loop: structs.Loop, launches: Any, number: dict[int, int]):
        self._input = stages
        self._lists = {k: np.array([number[id(x)] for x in getattr(stages, k)], np.int32) for k in LISTS}
        self._state = (structs.StageState * loop.bodies)()
        for state in self._state:
            state.factor_step = state.euler_step = -1
        self.native = structs.Stages(
            firsts=len(stages.first), agains=len(stages.again), ends=len(stages.end), factor_alone=stages.factor_alone,
            state=c.addressof(self._state),
        )  # fmt: skip
        for name in NODAL:
            setattr(self.native, name, number[id(getattr(stages, name))])
        for name, array in self._lists.items():
            setattr(self.native, name, array.ctypes.data)
        self._first_stage = np.zeros((len(stages.mass), 9))
        self.native.first_stage = self._first_stage.ctypes.data
        for name in ("estimate", "bound", "mass", "share", "weight", "diagonal",
                     "start_x", "start_v", "b", "inertial_increment", "unheld", "held_moves"):  # fmt: skip
            setattr(self.native, name, getattr(stages, name).ctypes.data)
        loop.stages = c.addressof(self.native)
        _tell_bodies_apart(stages.parts, launches, number)

    def state(self) -> list[StateArray]:
        """Returns what steps carry on."""
        return [host_array("engine.stages", memory_of(self._state, len(self._state)), same_body)]


def _tell_bodies_apart(parts: Mapping[int, Int32 | None], launches: Any, number: dict[int, int]) -> None:
    """Gives launches the first item of each body. parts: by id of a launch; number: of each launch by id."""
    for key, part in parts.items():
        launches[number[key]].parts = None if part is None else part.ctypes.data


class _NativeEuler:
    """The input of steps of backward Euler in a scene of another scheme, attached to a loop."""

    def __init__(self, euler: EulerForm, loop: structs.Loop, launches: Any, number: dict[int, int]):
        self._input, detect = euler, [number[id(x)] for x in euler.detect]
        self._launch = np.array([number[id(x)] for x in euler.assemble], np.int32)
        self._settle = np.array([number[id(x)] for x in euler.settle], np.int32)
        self._result = (structs.SolveResult * loop.bodies)()
        self._own: dict[str, NDArray[Any]] = {
            "end_x": np.zeros_like(euler.start_x), "takes": np.zeros(loop.bodies, np.int32),
            "assembled": np.zeros(loop.bodies, np.int32), "launch": self._launch, "settle": self._settle,
            "touching": np.zeros(loop.bodies, np.int32), "solution": np.zeros_like(euler.start_x),
        }  # fmt: skip
        self.native = structs.EulerForm(
            launches=len(self._launch), settles=len(self._settle), detect=min(detect, default=0), detects=len(detect),
            restore=number[id(euler.restore)], advance=number[id(euler.advance)],
            own_coefficients=tuple(euler.coefficients.tolist()), euler_coefficients=euler.euler_coefficients,
            result=c.addressof(self._result),
        )  # fmt: skip
        for name, array in self._own.items():
            setattr(self.native, name, array.ctypes.data)
        for name in ("coefficients", "start_x", "start_v", "before", "earlier", "diagonal", "block_scale"):
            setattr(self.native, name, getattr(euler, name).ctypes.data)
        loop.euler = c.addressof(self.native)
        _tell_bodies_apart(euler.parts, launches, number)

    def state(self) -> list[StateArray]:
        """Returns what steps carry on."""
        return [
            host_array("engine.euler.touching", self._own["touching"], same_body),
            host_array("engine.euler.solution", self._own["solution"], resets=False),
        ]


class _NativeSubsteps:
    """The input of explicit substeps and its memory, attached to a loop. number: of each launch by id."""

    def __init__(self, given: CentralDifference, loop: structs.Loop, number: dict[int, int]):
        self._input = given
        self._stable = np.zeros(loop.bodies, structs.STABLE_STEP)
        given.set_bodies(self._stable)
        self._result = (structs.SolveResult * loop.bodies)()
        self.native = structs.CentralDifference(
            held=given.held, stable=self._stable.ctypes.data, result=c.addressof(self._result),
            **{name: number[id(getattr(given, name))] for name in NODAL_OF_SUBSTEPS},
        )  # fmt: skip
        for name in ("substep", "shift_time", "mass", "free", "force", "kept_x", "kept_force", "mode", "failed"):
            setattr(self.native, name, getattr(given, name).ctypes.data)
        self.native.state.round = 1
        loop.substeps = c.addressof(self.native)

    def state(self) -> list[StateArray]:
        """Returns what steps carry on: the estimate of the stable substep, which no reset takes back."""
        state = np.frombuffer(self.native.state, np.uint8)
        arrays: dict[str, NDArray[Any]] = {
            "stable": self._stable.view(np.uint8),
            "state": state,
            "mode": self._input.mode,
        }
        return [host_array(f"engine.substeps.{name}", array, resets=False) for name, array in arrays.items()]


MOST_MODES = 600  # of the coarse space of an island of bodies


class _NativeContact:
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

    def _join(self, free: Reals, rows: int, loop: structs.Loop) -> None:
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


class _NativeRefresh:
    """What A of a body had on its diagonal when copies were taken, and room to solve directly where it changed most."""

    def __init__(self, body: Any, blocks: int):
        n = body.last - body.first
        capacity = min(WIDEST_CUT * blocks, LARGEST_CUT)
        self.carried: dict[str, NDArray[Any]] = {
            "step": np.full(KNOWN_DIAGONALS, -1, np.int64), "block": np.zeros((KNOWN_DIAGONALS, n, 6), np.float32)
        }  # fmt: skip
        self._room: dict[str, NDArray[Any]] = {
            "at_rest": np.zeros(n), "changed_at": np.zeros(n), "free": np.ones(n), "node": np.zeros(n, np.int32),
            "place": np.zeros(n, np.int32), "first": np.zeros(3 * n, np.int32), "row": np.zeros(3 * n, np.int64),
            "envelope": np.zeros(capacity), "t": np.zeros(3 * n), "room": np.zeros(3 * n),
        }  # fmt: skip
        self._score = np.zeros(n)
        self._nodes = structs.CutNodes(nodes=n, capacity=capacity)
        for name, array in self._room.items():
            setattr(self._nodes, name, array.ctypes.data)
        self.native = structs.KnownDiagonals(
            kept=KNOWN_DIAGONALS, slow=-1, score=self._score.ctypes.data, room=c.addressof(self._nodes),
            **{name: array.ctypes.data for name, array in self.carried.items()},
        )  # fmt: skip
        body.correction.known = c.addressof(self.native)

    def state(self, name: str) -> list[StateArray]:
        """Returns what steps carry on; no reset takes it back."""
        arrays = [host_array(f"{name}.{k}", a, resets=False) for k, a in self.carried.items()]
        return [replace(a, added=True) for a in (numbers_array(f"{name}.numbers", self.native), *arrays)]


REFRESHED_NODES = 500  # of a body from which on its factors may be refreshed
KNOWN_DIAGONALS = 8  # copies of a body that are remembered: more than are under way at a time
LARGEST_CUT = 4_000_000  # entries of the envelope
WIDEST_CUT = 30 * 9  # as ENOUGH_FOR_CUTS of native/cut_nodes.h, in numbers of A a block


class _NativeCut:
    """Nodes of a body that may lose elements, and room for a direct solve on those that did."""

    def __init__(self, given: CutInput, body: Any, dt: float, arrays: Mapping[str, NDArray[Any]]):
        n = body.last - body.first
        blocks = int(arrays["row_start"][body.last] - arrays["row_start"][body.first])
        capacity = min(int((WIDEST_CUT * blocks * 3 * n) ** 0.5), LARGEST_CUT)  # rows of these widths have no more
        room: dict[str, NDArray[Any]] = {
            "node": np.zeros(n, np.int32), "place": np.zeros(n, np.int32), "first": np.zeros(3 * n, np.int32),
            "row": np.zeros(3 * n, np.int64), "envelope": np.zeros(capacity), "t": np.zeros(3 * n),
            "room": np.zeros(3 * n),
        }  # fmt: skip
        room |= {name: getattr(given, name)[body.first : body.last] for name in ("at_rest", "changed_at", "free")}
        if given.origin is not None and given.copied_at is not None:
            room |= {"origin": given.origin[body.first : body.last], "root": np.zeros(n, np.int32)}
            room["copied_at"] = given.copied_at[body.first : body.last]
        self._room = room
        self.native = structs.CutNodes(nodes=n, capacity=capacity, dt=dt)
        for name, array in room.items():
            setattr(self.native, name, array.ctypes.data)
        body.correction.cut = c.addressof(self.native)


def _binding(launch: CpuLaunch) -> structs.Binding:
    """Arguments of a launch that the loop has not taken up yet."""
    return structs.Binding(params=c.addressof(launch.params), items=launch.items, taken=-1)


class CpuEngine(Reports):
    """The loop over one system. records, frames: numbers of them that its rings hold."""

    capabilities = frozenset(Capability)

    def __init__(self, given: EngineInput, records: int | None = None, frames: int = 8):
        self._native = _library()
        spawn = given.cut.spawn if given.cut else None
        others = [part.launches for part in (given.stages, given.euler, given.substeps, given.halving) if part]
        listed = cast(
            list[CpuLaunch],
            [
                *given.assemble,
                *given.integrate,
                *(x for part in others for x in part),
                *given.history,
                *([spawn] if spawn else []),
            ],
        )
        launches = list({id(launch): launch for launch in listed}.values())  # some take part in several stages
        arrays, ranges = given.arrays, given.ranges
        nodes, bodies = len(arrays["x"]), len(ranges)
        self.launches = launches
        self._bindings = [_binding(x) for x in launches]
        self._launch = (structs.Launch * max(len(launches), 1))()
        for entry, launch, binding in zip(self._launch, launches, self._bindings, strict=False):
            entry.kernel, entry.binding = launch.function, c.addressof(binding)
        self._body = (structs.Body * bodies)()
        for entry_body, (first, last) in zip(self._body, ranges, strict=True):
            entry_body.first, entry_body.last, entry_body.snapshot_step = first, last, -1
        self._work = np.zeros(structs.WORK * nodes)
        self._corrections: dict[int, Any] = {}
        self._arrays = arrays
        self._mail: list[Mailbox] = [Mailbox([]) for _ in ranges]
        self._copies: list[Reals | None] = [None] * bodies
        self._posted: dict[int, Any] = {}
        self._changes: list[Any] = []  # those posted last, and what they point to
        loop = structs.Loop()
        super().__init__(loop, bodies, given.dt, records, np.zeros((frames, 2, nodes, 3)))
        loop.before, loop.launches = len(given.assemble), len(given.assemble) + len(given.integrate)
        loop.launch = c.addressof(self._launch)
        loop.bodies, loop.nodes, loop.body = bodies, nodes, c.addressof(self._body)
        for name in ("row_start", "columns", "values", "b", "y", "x", "v", "clock", "moving"):
            setattr(loop, name, arrays[name].ctypes.data)
        loop.work, loop.threads = self._work.ctypes.data, usable_threads(given.solver.threads)
        self._rank_one = given.rank_one and _NativeRankOne(given.rank_one, arrays["rotation"], loop)
        self._newton = None
        if given.newton:
            late = [x.domain == "blocks" and given.held is None for x in given.assemble]  # holders take forces from A
            self._newton = _NativeNewton(given.newton, late, loop, self._launch)
        number = {id(launch): k for k, launch in enumerate(launches)}
        self._history = np.array([number[id(launch)] for launch in given.history], np.int32)
        if spawn:
            loop.spawn = c.addressof(self._launch[number[id(spawn)]])
            blocks = [k for k, launch in enumerate(launches) if launch.domain == "blocks"]
            self._of_blocks = np.array(blocks, np.int32)
            loop.of_blocks, loop.blocks_launches = self._of_blocks.ctypes.data, len(blocks)
            for k in blocks:
                self._bindings[k].items = (int(arrays["row_start"][nodes]) - nodes) // 2
        loop.history, loop.histories, loop.advanced = self._history.ctypes.data, len(self._history), -1
        self._stages = given.stages and _NativeStages(given.stages, loop, self._launch, number)
        self._euler = given.euler and _NativeEuler(given.euler, loop, self._launch, number)
        self._substeps = given.substeps and _NativeSubsteps(given.substeps, loop, number)
        self._halving = given.halving and NativeHalving(given.halving, loop, number)
        if given.halving:
            _tell_bodies_apart(given.halving.parts, self._launch, number)
        self._contact = given.contact and _NativeContact(given.contact, loop, arrays)
        if self._contact and given.euler:  # bodies whose step is made have the velocities of its end
            self._contact.native.predictor = given.euler.start_v.ctypes.data
        elif self._contact and self._newton:
            self._contact.native.predictor = self._newton.search_in_contact(bodies).ctypes.data
        starts = arrays["row_start"]
        self._refresh = {
            i: _NativeRefresh(entry, int(starts[entry.last] - starts[entry.first]))
            for i, entry in enumerate(self._body)
            if entry.last - entry.first >= REFRESHED_NODES and given.solver.preconditioner in ("auto", "cholesky")
        }
        self._cut: dict[int, _NativeCut] = {}
        if given.cut and given.solver.wants_factors:
            self._cut = {i: _NativeCut(given.cut, self._body[i], given.dt, arrays) for i in given.cut.bodies}
        obstacles = len(given.contact.obstacles.kind) if given.contact else 0
        if given.held is not None:
            loop.holders, loop.held_reaction = given.held.shape[1], given.held.ctypes.data
        self._held = given.held
        self.report_reactions(obstacles + loop.holders, obstacles)
        if given.measured:
            self._measured_first = self.report_readings(given.measured, bodies)
            addresses = [m.array.ctypes.data + m.array.itemsize * m.index for m in given.measured]
            self._measured = np.array(addresses, np.uint64)
            loop.measured, loop.measured_first = self._measured.ctypes.data, self._measured_first.ctypes.data
        if given.touch is not None:
            touch = cast(CpuLaunch, given.touch)
            loop.touch = c.addressof(self._launch[number[id(touch)]])
            loop.react = touch.module.address("react")
        self._energies = NativeEnergies(given.energies)
        loop.energies = c.addressof(self._energies.native)
        self.begin: Sequence[Launch] = ()  # before the first step
        self._begun = False
        self._corrects_resumed: dict[int, bool] = {}  # bodies whose correction is of the factor that was in use

    # --- running ------------------------------------------------------------------------------------------------

    def run(self, steps: int) -> int:
        """Runs up to `steps` steps without Python; returns those done (fewer only after `stop`)."""
        self._begin()
        return int(self._native.wf_run(c.byref(self.loop), steps))

    def assemble(self) -> None:
        """First half of one step: the system matrix and right-hand side."""
        self._begin()
        self._native.wf_assemble(c.byref(self.loop))

    def factor_matrix(self, body: int) -> Reals:
        """Returns the values of A as last assembled, with the contacts that a factor is to know, (blocks, 3, 3).

        To be called between `assemble` and `solve`.
        """
        entry, start = self._body[body], self._arrays["row_start"]
        self._native.wf_note_matrix(c.byref(self.loop), body)
        values: Reals = self._arrays["values"][start[entry.first] : start[entry.last]]
        if not self._contact:
            return values
        out = np.empty_like(values)
        self._native.wf_copy_matrix(c.byref(self.loop), body, out.ctypes.data)
        return out[:]  # a view, which is not recycled as the copies that were asked for are (updates/snapshots.py)

    def solve(self) -> None:
        """Second half: solve, integrate, report."""
        self._native.wf_solve(c.byref(self.loop))

    def restart_clock(self) -> None:
        """Takes what was waited for since `assemble` out of the time of the step."""
        self.loop.assemble_begin = time.monotonic() - self.loop.assemble_seconds
        self.loop.cpu_begin = time.thread_time() - self.loop.assemble_seconds

    def _begin(self) -> None:
        """Runs the launches of the scheme that come before the first step."""
        if self.step == 0:
            self.take_changes()
        if self.step == 0 and not self._begun:
            for launch in self.begin:
                launch()

    def prepare(self) -> None:
        """Makes the state before the first step now, and not again when it begins."""
        self._begin()
        self._begun = True

    # --- what steps carry on --------------------------------------------------------------------------------------

    def state(self) -> list[StateArray]:
        """Returns what native code carries on beside the arrays that launches write."""
        listed = (self._stages, self._euler, self._substeps, self._halving, self._contact)
        parts = [part.state() for part in listed if part]
        corrections = [self._state_of_correction(k) for k in self._corrections]
        own = [
            host_array("engine.balance", self._energies.balance.view(np.uint8), resets=False),
            host_array("engine.clock", self._arrays["clock"], resets=False),
        ]
        known = [refresh.state(f"engine.known{k}") for k, refresh in self._refresh.items()]
        return [*own, *(a for part in (*parts, *corrections, *known) for a in part)]

    def _state_of_correction(self, body: int) -> list[StateArray]:
        """Returns what is known of the changes since the matrix of the factor in use. No reset takes it back."""
        name, entry = f"engine.correction{body}", self._body[body]
        rooms = [(k, a) for k, a in self._corrections[body].items() if k not in ("diagonal", "block")]

        def is_of_factor() -> NDArray[Any]:
            return np.array([bool(entry.factor) and not entry.mail and entry.correction.factor == entry.factor])

        def set_of_factor(value: NDArray[Any]) -> None:
            self._corrects_resumed[body] = bool(value[0])

        found = [numbers_array(f"{name}.numbers", entry.correction)]
        found.append(StateArray(f"{name}.is_of_factor", is_of_factor, set_of_factor, resets=False))
        return found + [host_array(f"{name}.{k}", a, resets=False) for k, a in rooms]

    def resume(self, step: int, start_time: float) -> None:
        """Goes on from a state that was written, after `step` steps."""
        self.loop.step, self.loop.start_time, self.loop.advanced, self._begun = step, start_time, -1, True
        for cut in self._cut.values():
            cut.native.start_time = start_time
        for entry in self._body:
            entry.steps = step
        self._energies.resume(self._arrays["x"], self._arrays["v"])
        for number, (*_, (binding, _)) in self._posted.items():  # what was posted is what the loop had: no news
            if self._native.wf_post_binding(c.byref(self._launch[number]), None):
                self._launch[number].binding, binding.taken = c.addressof(binding), step

    def restart(self, bodies: Sequence[int]) -> None:
        """Begins the energy balances of bodies anew."""
        given = np.array(bodies, np.int32)
        self._native.wf_restart(c.byref(self.loop), given.ctypes.data, len(given))

    def wait(self) -> bool:
        """Sleeps until the next step is due (real time) and while paused, as `run` does before each step.

        False if the loop is to stop.
        """
        return bool(self._native.wf_wait(c.byref(self.loop)))

    def settings(self, body: int) -> structs.SolveSettings:
        """Solver settings of a body; what is set holds from its next solve on."""
        settings: structs.SolveSettings = self._body[body].settings
        return settings

    def correct(self, body: int, nodes: int, diagonal: Reals, double: bool = False, block: Reals | None = None) -> None:
        """Factors of the body are corrected for what has come onto the diagonal since their matrix, or has left it, at
        so many nodes at most (backends/cpu/native/woodbury.h).

        nodes: 1 to 64. diagonal: (nodes of the scene,) [kg], as assembled. double: also factors in float64. block: as
        in base.Engine. Before the first step only.
        """
        assert 1 <= nodes <= structs.MAX_CORRECTED
        entry = self._body[body]
        count, width = entry.last - entry.first, -(-3 * nodes // 8) * 8
        room: dict[str, NDArray[Any]] = {
            "last": np.full(count, 0.0), "then": np.full(count, 0.0),
            "change": np.zeros(HISTORY, structs.CHANGE),
            "node": np.full(nodes, 0, np.int32), "supernode": np.full(3 * count, 0, np.int32),
            "marked": np.full(3 * count, 0, np.uint8), "delta": np.full((3 * nodes, 3 * nodes), 0.0),
            "small": np.full(4 * width**2 + 2 * width, 0.0),
            "columns": np.zeros((3 * count, width), np.float64 if double else np.float32),  # touched by the first grab
            "diagonal": diagonal[entry.first : entry.last],
        }  # fmt: skip
        self._corrections[body] = room
        correction = entry.correction
        correction.capacity, correction.history, correction.nodes, correction.forgotten = nodes, HISTORY, count, -1
        if block is not None:
            room["block"] = block[entry.first : entry.last]
        if self._contact:
            each, most = KNOWN_CONTACTS
            touches = min(each * self._contact.surface_nodes(body), most)
            correction.touches, correction.touch_lost = touches, -1
            room |= {
                "touch": np.zeros(touches, structs.KNOWN_CONTACT), "touch_now": np.zeros((count, 9)),
                "touch_then": np.zeros((count, 9)), "link_now": np.zeros(touches, structs.KNOWN_CONTACT),
                "link_then": np.zeros(touches, structs.KNOWN_CONTACT),
            }  # fmt: skip
        for name, array in room.items():
            setattr(correction, name, array.ctypes.data)

    def corrected(self, body: int) -> int:
        """Number of nodes at which the last solve corrected the factor in use. A probe for tests; only while the loop
        stands still."""
        return int(self._body[body].correction.used)

    def forget_matrices(self, body: int) -> None:
        """Has no factor of the body refreshed from now on. For benchmarks; only while the loop stands still."""
        self._body[body].correction.known = None

    def refreshed(self, body: int) -> int:
        """Number of nodes on which the last solve was exact beside its factor. A probe for tests; only while the loop
        stands still."""
        return int(self._refresh[body].native.refreshed) if body in self._refresh else 0

    def cut_nodes(self, body: int) -> tuple[int, int, int]:
        """Nodes that lost elements since the matrix of the factor in use, with neighbours; those that the last solve
        treated; nodes without elements. A probe for tests; only while the loop stands still."""
        native = self._cut[body].native
        return native.wanted, native.count, native.gone

    def precondition(self, body: int, r: Reals) -> Reals:
        """P^-1 r, (3 nodes of the body,), with its factor as the next solve has it. A probe for tests. Needs a factor
        and an assembled matrix; r must not be 0."""
        r = np.ascontiguousarray(r, dtype=np.float64)
        z, work = np.empty_like(r), np.empty(2 * len(r))
        self._native.wf_precondition(c.byref(self.loop), body, r.ctypes.data, z.ctypes.data, work.ctypes.data)
        return z

    # --- mailboxes ----------------------------------------------------------------------------------------------

    def post_factor(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        """Puts a factor into a free buffer; the loop takes it up before its next solve of the body."""
        buffer = self._free_buffer(body, pattern, values.dtype)
        buffer.fill(values, step)
        self._mail[body].waiting = buffer
        self._native.wf_post_factor(c.byref(self._body[body]), buffer.address)

    def post_factors(self, bodies: Sequence[int], factors: Sequence[Factor]) -> None:
        """Posts factors of different bodies, one of each, whose values the loop reads in place."""
        for body, factor in zip(bodies, factors, strict=True):
            buffer = self._free_buffer(body, factor.pattern, factor.values.dtype)
            buffer.take(factor.values, factor.step)
            self._mail[body].waiting = buffer
            self._native.wf_post_factor(c.byref(self._body[body]), buffer.address)

    def prepare_for_factors(self) -> None:
        """Does nothing."""

    def prepare_factor(self, body: int, factor: Factor, r: Float64) -> None:
        """Returns None: a factor is applied as it comes."""

    def may_prepare(self, body: int) -> bool:
        """Returns True: nothing is prepared on a CPU."""
        return True

    def drop_factor(self, body: int, factor: Factor) -> None:
        """Does nothing."""

    def factor_memory(self, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        """Makes an array for values of a factor."""
        return np.empty(count, dtype)

    def expect_factors(self, body: int, pattern: FactorPattern) -> None:
        """Does nothing: a factor is applied as it comes."""

    def expects_factors(self) -> bool:
        """Returns True."""
        return True

    def resume_factor(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        """Posts the factor that was in use when the state was saved; what is known of its correction holds."""
        self.post_factor(body, pattern, values, step)
        buffer = self._mail[body].waiting
        if self._corrects_resumed.get(body) and buffer is not None:
            self._body[body].correction.factor = buffer.address

    @property
    def substeps(self) -> int:
        """Explicit substeps of the step under way, or of the last one; 0: an implicit scheme, or not known yet."""
        return int(self._substeps.native.state.substeps) if self._substeps else 0

    def settle_factors(self) -> None:
        """Blocks until posted factors are in use. No-op on the CPU."""

    def _free_buffer(self, body: int, pattern: FactorPattern, dtype: np.dtype) -> NativeFactor:
        """Returns a buffer that the loop does not use. A waiting factor is taken back: a newer one comes.

        Which one the loop has follows from what the mailbox gives back. Its own pointer would not do: between taking
        a factor out of the mailbox and noting it there the loop has both.
        """
        mail = self._mail[body]
        taken_back = self._native.wf_post_factor(c.byref(self._body[body]), None)
        if not taken_back and mail.waiting is not None:
            mail.in_use = mail.waiting
        mail.waiting = None
        for i, buffer in enumerate(mail.buffers):
            if buffer is mail.in_use:
                continue
            if buffer.pattern is not pattern or buffer.values.dtype != dtype:
                mail.buffers[i] = NativeFactor.empty(self._native_pattern(mail, pattern), dtype)
            return mail.buffers[i]
        mail.buffers.append(NativeFactor.empty(self._native_pattern(mail, pattern), dtype))
        return mail.buffers[-1]

    def _native_pattern(self, mail: Mailbox, pattern: FactorPattern) -> NativePattern:
        if mail.pattern is None or mail.pattern.pattern is not pattern:
            mail.pattern = NativePattern(pattern, self.loop.threads)
        return mail.pattern

    def factor_step(self, body: int) -> int:
        """Step of the factor in use, -1 without one."""
        address = self._body[body].factor
        return int(c.cast(address, c.POINTER(structs.Factor)).contents.step) if address else -1

    def factor_buffers(self, body: int) -> list[NativeFactor]:
        """Returns all factors of a body that are in memory. A probe for tests."""
        return self._mail[body].buffers

    def factor_bytes(self, body: int) -> int:
        """Returns the bytes of values and rows that one application of the newest factor reads; 0 without one."""
        mail = self._mail[body]
        newest = mail.waiting or mail.in_use
        return newest.values.nbytes + newest.pattern.rows.nbytes if newest else 0

    def request_matrix(self, body: int, target: Reals) -> None:
        """The loop copies the values of A into `target` once they are next assembled."""
        self._request(body, target, -1.0)

    def request_positions(self, body: int, target: Reals, ahead: float = 0.0) -> None:
        """The loop copies x + ahead v, (nodes, 3), into `target` when it next assembles; ahead: 0 or more [s].

        In all else like `request_matrix`; each replaces what the other asked for.
        """
        self._request(body, target, ahead)

    def _request(self, body: int, target: Reals, ahead: float) -> None:
        entry = self._body[body]
        entry.snapshot = None  # or the loop might take one request for the other
        self._copies[body] = target
        entry.snapshot_step, entry.ahead = -1, ahead
        entry.snapshot = target.ctypes.data

    def matrix_step(self, body: int) -> int:
        """Step of the copy asked for last, -1 while it is not there. `step` counts the steps completed before it."""
        return int(self._body[body].snapshot_step)

    def matrix_steps(self, bodies: Sequence[int]) -> Int64:
        """The same of some bodies."""
        return np.array([self._body[body].snapshot_step for body in bodies], np.int64)

    def copy_memory(self, body: int) -> None:
        """The loop copies to where it is told."""
        return None

    def stage(self, changes: Sequence[ArrayChange]) -> list[ArrayChange]:
        """Returns the changes, which are ready."""
        return list(changes)

    def change(self, changes: Sequence[ArrayChange]) -> structs.Changes:
        """Has the loop copy new contents into arrays between two steps: those after the result's `taken` steps, once it
        is not below 0."""
        copies = (structs.Copy * max(len(changes), 1))()
        for copy, (target, source) in zip(copies, changes, strict=False):
            copy.target, copy.source, copy.bytes = target.ctypes.data, source.ctypes.data, target.nbytes
        posted = structs.Changes(copies=c.addressof(copies), count=len(changes), taken=-1)
        under_way = [each for each in self._changes if each[0].taken < 0]
        self._changes = [*under_way, (posted, copies, changes)]
        self._native.wf_post_changes(c.byref(self.loop), c.addressof(posted))
        return posted

    def withdraw_changes(self) -> bool:
        """Takes back what `change` posted and the loop has not taken up; False if there was nothing."""
        back = bool(self._native.wf_post_changes(c.byref(self.loop), None))
        if back:
            self._changes.pop()
        return back

    def take_changes(self) -> None:
        """Copies what waits at once, while the loop stands still."""
        self._native.wf_take_changes(c.byref(self.loop))

    def replace(self, launch: int, new: Launch) -> structs.Binding:
        """Gives a launch other arguments, from the next step on: the one after the result's `taken` steps, once it is
        not below 0."""
        binding = _binding(cast(CpuLaunch, new))
        displaced = self._native.wf_post_binding(c.byref(self._launch[launch]), c.addressof(binding))
        kept = self._posted.setdefault(launch, [])  # in use, waiting
        if displaced:
            kept.pop()  # it was never taken up; what is in use must live on
        else:
            del kept[:-1]  # the last one was taken up, so those before are done with
        kept.append((binding, new))
        return binding
