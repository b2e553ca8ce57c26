# SPDX-License-Identifier: MIT
"""Counters of the updates of all bodies, a column for each, so that a round of the service thread sums up and ranks a
thousand bodies in a few calls of native code (update_table.cpp). body_state.py reads and writes the row of one body.
"""

import ctypes as c
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.shared_memory.located import address
from sim_server.arrays import Float64, Int64
from sim_server.backends.compiler import native
from sim_server.backends.declarations import Declarations
from sim_server.updates.makers import Makers
from sim_server.updates.stats import updated

SOURCE = "updates/update_table.cpp"
TEXT = Declarations(SOURCE)
NONE: int = TEXT.constant("NO_STEP")  # of a step: there is none
COLUMNS: dict[type, tuple[str, ...]] = {
    np.float64: ("excess", "iteration_cost", "factorization_cost", "lost", "latest"),
    np.int64: ("body", "waited", "age", "failures"),
    np.bool_: ("in_flight", "on_trial"),
}  # of UpdateRequests
RAN_AWAY, ABANDONED = TEXT.enumerators["RAN_AWAY"], TEXT.enumerators["ABANDONED"]


@TEXT.struct
class Table(c.Structure):
    """Addresses of the columns of a table."""


@TEXT.struct
class Requests(c.Structure):
    """Addresses of the columns of UpdateRequests."""


Flags = NDArray[np.bool_]


@dataclass(eq=False)
class UpdateRequests:
    """What the scheduler knows of some bodies: arrays with an entry for each. Those of UpdateTable hold until it
    is asked again.

    body: its number
    excess: summed iterations above the floor
    waited: steps since its last matrix was sent; -1: none was yet
    in_flight: a matrix of it is being copied or factorized
    age: steps since the matrix of its factor; -1: it has no factor
    iteration_cost, factorization_cost: in any unit, as long as it is the same for all bodies
    failures: jobs in a row that brought no factor
    lost: summed iterations above the floor of solves with the factor in use
    on_trial: a new factor is wanted for a comparison, whatever was lost
    latest: excess of the last solve
    native: addresses of these arrays; None: not known yet
    """

    body: Int64
    excess: Float64
    waited: Int64
    in_flight: Flags
    age: Int64
    iteration_cost: Float64
    factorization_cost: Float64
    failures: Int64
    lost: Float64
    on_trial: Flags
    latest: Float64
    native: Requests | None = field(default=None, init=False)

    def __len__(self) -> int:
        return len(self.body)

    def of(self, chosen: Any) -> "UpdateRequests":
        """Returns the requests that an index or a mask chooses."""
        return UpdateRequests(*(getattr(self, each.name)[chosen] for each in fields(self) if each.init))


def addresses(columns: Mapping[str, NDArray[Any]]) -> Requests:
    """Returns the addresses of columns, contiguous and of the types of COLUMNS, which must be kept."""
    return Requests(**{name: address(column) for name, column in columns.items()})


@cache
def library() -> Any:
    """Compiles and loads update_table.cpp. Its functions keep Python's lock: they take 10 us for a thousand bodies.
    Raises CompileError."""
    i, n, p = c.c_int32, c.c_int64, c.c_void_p
    signatures: dict[str, tuple[Any, list[Any]]] = {
        "wf_told": (i, [p, n]), "wf_mean": (c.c_double, [p, n]),
        "wf_observe": (i, [p, p, n, i]), "wf_count": (None, [p, p]), "wf_copying": (n, [p, p]),
        "wf_requests": (n, [p, n, i, p, p, p]), "wf_factors": (None, [p, p, p, p, n, n, p]),
        "wf_pick": (n, [p, n, n, n, i, c.c_double, p]),
    }  # fmt: skip
    compiled = native(SOURCE, signatures, stepping=False, lock=True)
    TEXT.check_sizes(compiled)
    return compiled


def told(records: NDArray[Any]) -> int:
    """Returns what contiguous records tell beside their sums: RAN_AWAY | ABANDONED, if any body did, any factor was."""
    return int(library().wf_told(address(records), len(records)))


class UpdateTable:
    """A row for each body. Means are NaN while they are not known, steps NONE.

    excess, latest, lost, factor_step, max_factor_age, iteration_cost, first_excess: as in SolveStatistics
    refused, failures, assemblies: as `refused`, `in_a_row`, `assemblies` in FailureState
    newest, latency, cost, used, regularized: as in FactorStatistics; dropped: the newest factor is useless
    makers: of the last factors
    sent, in_flight, checked, excess_sent, request, requested, extrapolated, positions: as in JobState
    copying: a copy is requested, or waits to be sent
    copies, matrices: as in JobState, lists; copy_at: addresses of these copies; matrix_steps: of these matrices
    frozen, error_bound: as in BodyUpdateState
    """

    def __init__(self, bodies: int):
        def zeros() -> Float64:
            return np.zeros(bodies)

        def unknown() -> Float64:
            return np.full(bodies, np.nan)

        def steps() -> Int64:
            return np.full(bodies, NONE, np.int64)

        self.excess, self.latest, self.lost, self.excess_sent = zeros(), zeros(), zeros(), zeros()
        self.factor_step, self.max_factor_age, self.newest, self.sent = steps(), steps(), steps(), steps()
        self.checked, self.matrix_steps, self.request = steps(), steps(), steps()
        self.requested, self.extrapolated, self.positions = zeros(), zeros(), np.zeros(bodies, np.bool_)
        self.copies: list[Float64 | None] = [None] * bodies
        self.copy_at = np.zeros(bodies, np.int64)
        self.matrices: list[Float64 | None] = [None] * bodies
        self.iteration_cost, self.latency, self.cost = unknown(), unknown(), unknown()
        self.first_excess = unknown()
        self.refused, self.failures, self.used = (np.zeros(bodies, np.int64) for _ in range(3))
        self.assemblies, self.regularized = (np.zeros(bodies, np.int64) for _ in range(2))
        self.makers = Makers(bodies)
        self.error_bound = np.full(bodies, np.inf)
        self.dropped, self.in_flight, self.copying, self.frozen = (np.zeros(bodies, np.bool_) for _ in range(4))
        self._columns = Table(bodies=bodies)
        for member in TEXT.members("Table")[:-1]:  # which stay where they are
            setattr(self._columns, member.name, address(getattr(self, member.name)))
        self._native = c.addressof(self._columns)
        self._counts = np.zeros(3, np.int64)
        self._asked: dict[str, NDArray[Any]] = {}
        for kind, names in COLUMNS.items():
            self._asked |= zip(names, np.empty((len(names), bodies), kind), strict=True)
        self._requests = addresses(self._asked)

    def __len__(self) -> int:
        return len(self.excess)

    def observe(self, records: NDArray[Any], floor: int) -> int:
        """Takes note of contiguous records (steps, bodies), as BodyUpdateState.observe does of each, in seconds.
        Returns what they tell (`told`).

        floor: iterations of a linear solve above which they are excess
        """
        return int(library().wf_observe(self._native, address(records), len(records), floor))

    def on_factors(self, bodies: Int64, made: Int64, seconds: Float64, step: int) -> list[bool]:
        """Takes note of factors of different bodies that came during a step, as BodyUpdateState.on_factor does of each,
        with costs in seconds. Returns of each whether it is newer than that of its body.

        made: step of the matrix of each. seconds: cost of its making
        """
        newer, given = np.empty(len(bodies), np.bool_), [address(each) for each in (bodies, made, seconds)]
        library().wf_factors(self._native, *given, len(bodies), step, address(newer))
        return list(newer.tolist())

    def counts(self) -> tuple[int, int, int]:
        """Returns how many bodies have a copy that is requested or waits to be sent, how many a job at a worker or a
        factor that is checked, and how many jobs that failed since their last factor."""
        library().wf_count(self._native, address(self._counts))
        copying, flying, failing = self._counts.tolist()
        return copying, flying, failing

    def mean(self, column: Float64) -> float | None:
        """Returns the mean of those numbers of a column of this table that are known; None: none is."""
        mean = float(library().wf_mean(address(column), len(self)))
        return None if mean != mean else mean

    def in_order_of_requests(self) -> Int64:
        """Returns the bodies whose copy is requested or waits to be sent, in the order of the requests."""
        found = np.empty(len(self), np.int64)
        return found[: library().wf_copying(self._native, address(found))]

    def requests(
        self, step: int, ahead: bool, on_trial: Sequence[bool], compared: Sequence[bool]
    ) -> UpdateRequests:  # fmt: skip
        """Returns what the scheduler is told of bodies at a step (Driver.requests), until this is asked again.

        ahead: only of bodies whose next matrix may go ahead of the check of their last factor
        on_trial, compared: of each body, what `auto` wants; empty: nothing
        """
        wanted = [np.array(each, np.bool_) if each else None for each in (on_trial, compared)]
        given = [None if each is None else address(each) for each in wanted]
        count = int(library().wf_requests(self._native, step, ahead, *given, c.addressof(self._requests)))
        made = UpdateRequests(**{name: column[:count] for name, column in self._asked.items()})
        made.native = self._requests
        return made


class Cell:
    """An attribute of a row object that stands in a column of the table: its `_table` and `_index` say where.

    column: empty: of the attribute's name
    """

    def __init__(self, column: str = ""):
        self._column = column

    def __set_name__(self, owner: type, name: str) -> None:
        self._column = self._column or name

    def __get__(self, row: Any, owner: type | None = None) -> Any:
        return getattr(row._table, self._column).item(row._index)

    def __set__(self, row: Any, value: Any) -> None:
        getattr(row._table, self._column)[row._index] = value


class MeanCell:
    """An exponential running mean in a column of the table; `value` is None before the first value."""

    __slots__ = ("_column", "_index")

    def __init__(self, column: Float64, index: int):
        self._column, self._index = column, index

    @property
    def value(self) -> float | None:
        """The mean."""
        mean = float(self._column[self._index])
        return None if mean != mean else mean

    def add(self, value: float) -> None:
        """Adds a value."""
        mean = self._column[self._index]
        self._column[self._index] = value if mean != mean else updated(float(mean), value)
