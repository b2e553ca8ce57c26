# SPDX-License-Identifier: MIT
"""The contract of a place where steps run, the processor or a GPU: all that the rest of the server uses of it.

A `Backend` compiles kernel texts and binds host arrays to them, which gives launches; its `engine` runs the launches of
a step and the solve between them, and has mailboxes that may be used from another thread meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager
from dataclasses import dataclass
from enum import Enum, IntEnum, auto
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor, FactorPattern
from sim_server.arrays import Float64, Int32, Int64
from sim_server.backends.factors_together import FactorsTogether
from sim_server.backends.shared_memory import SharedMemory
from sim_server.backends.state import StateArray

if TYPE_CHECKING:
    from sim_server.backends.central_difference import CentralDifference
    from sim_server.backends.contact import Contact
    from sim_server.backends.energies import Energies
    from sim_server.backends.euler_form import EulerForm
    from sim_server.backends.halving import Halving
    from sim_server.backends.measured import Measured
    from sim_server.backends.newton import Newton
    from sim_server.backends.rank_one import RankOne
    from sim_server.backends.rosenbrock import Rosenbrock
    from sim_server.scene.solver_options import SolverOptions


class Launch(Protocol):
    """One kernel with its arguments. name: TEXT.KERNEL. mailed: the arguments may be replaced while steps run."""

    name: str
    items: int
    mailed: bool

    @property
    def domain(self) -> str:
        """What its items are, as its text says: elements, nodes, blocks or another word."""
        ...

    def fetch(self, name: str) -> NDArray[Any]:
        """Returns one of its arrays as kernels have left it."""
        ...

    def written(self) -> list[tuple[str, NDArray[Any]]]:
        """Returns the arrays of the host that it may write, by the names of its struct's members."""
        ...

    def __call__(self) -> None:
        """Runs it once, outside of steps (set-up, energies, tests)."""
        ...


class Module(Protocol):
    """A compiled kernel text."""

    def bind(self, kernel: str, n: int, **arguments: Any) -> Launch:
        """Returns the launch of `kernel` over n items. arguments: arrays and numbers by the names of its struct.

        Raises TypeError where an argument does not fit the text.
        """
        ...


ArrayChange = tuple[NDArray[Any], NDArray[Any]]
"""An array that kernels read, and its new contents, of the same shape and type."""


StagedChange = Any
"""An ArrayChange that the engine has made ready (`stage`)."""


class PendingUpdate(Protocol):
    """New arguments of a launch, or new contents of arrays, on their way to the loop.

    taken: number of completed steps when the loop took them up; negative: not yet, or never if newer ones came
    """

    taken: int


class Capability(Enum):
    """What not every engine can do."""

    EXACT_STEPS = auto()
    """Settings and factors hold from the very next solve on; without it from the next batch of steps on."""
    MATRIX_POSITIONS = auto()
    """Positions requested are those that the next matrix is assembled from, extrapolated if wanted; without it those at
    the end of that step."""
    LOW_RANK_UPDATE = auto()
    """`correct` has a factor corrected for springs that came after its matrix; a GPU does so by itself."""


class SolveSettings(Protocol):
    """Settings of the solves of a body; what is set holds from the next solve, or batch of steps, on.

    kind: a Kind. budget: of wall time [s]; negative: of iterations. probe: a solve that `auto` measures. omega: of SSOR
    position: largest error of a node [m], 0: any. trust: times the estimate with a factor is at least the error
    dx_dv: of the step [s]. step_budget: of wall time of a step [s], 0: any
    most_linearizations: of a step that a budget ended (replays), 0: those of the scene
    """

    tolerance: float
    budget: float
    max_iterations: int
    kind: int
    warm_start: int
    probe: int
    omega: float
    position: float
    trust: float
    dx_dv: float
    step_budget: float
    most_linearizations: int


class Due(IntEnum):
    """What the wait for a step ended with."""

    STOP = 0  # the loop is to stop
    NEXT = 1  # a step of a run
    SINGLE = 2  # one of those that are made in a pause; it is not counted any more


class LoopState(Protocol):
    """Memory that a running loop shares with other threads.

    step: number of completed steps. start_time: of the simulation at step 0 [s]
    realtime, patient, stop: 0 or 1, set by others
    pause: number of a pause, 0: none, set by others; halted: the pause in which the loop stands still, 0: it does not
    single: steps that it is to make while it is paused
    hold: number of a request to stand still between two steps, 0: none; held: the last one that it has followed
    frame_every, energy_every: steps between those that are reported, 0: none
    deadline: of the next step, 0: at once [s]
    wake: descriptor (eventfd) to which it writes when a matrix that was asked for is there; 0: none
    record_capacity: records that find room
    late_steps, frames_dropped, records_dropped, others_dropped (reactions on what is no obstacle): numbers so far
    """

    step: int
    start_time: float
    realtime: int
    patient: int
    stop: int
    pause: int
    halted: int
    single: int
    hold: int
    held: int
    deadline: float
    wake: int
    frame_every: int
    energy_every: int
    record_capacity: int
    late_steps: int
    frames_dropped: int
    records_dropped: int
    others_dropped: int


class Engine(Protocol):
    """The loop over the steps of one scene.

    loop: memory shared with the running loop
    frame_poses: of the frames returned last, by step: position [m] and quaternion w, x, y, z of each obstacle
        (obstacles, 7)
    readings: of the records returned last, the numbers of `measured` of the body of each, (k, most of a body)
    begin: launches that make the state before the first step; set before it
    """

    loop: LoopState
    frame_poses: dict[int, Float64]
    readings: Float64
    begin: Sequence[Launch]

    @property
    def capabilities(self) -> frozenset[Capability]:
        """What this engine can do beyond the others."""
        ...

    @property
    def launches(self) -> Sequence[Launch]:
        """Launches of a step, before and after the solve."""
        ...

    @property
    def records_dtype(self) -> np.dtype[np.void]:
        """Type of step records."""
        ...

    @property
    def step(self) -> int:
        """Number of completed steps."""
        ...

    def run(self, steps: int) -> int:
        """Runs up to `steps` steps without Python's lock; returns those done, fewer only after a stop.

        Raises DeviceLost.
        """
        ...

    def assemble(self) -> None:
        """Runs the first half of one step: the system matrix, on the host too, and the right-hand side."""
        ...

    def solve(self) -> None:
        """Runs the second half: solve, integrate, report."""
        ...

    def restart_clock(self) -> None:
        """Between `assemble` and `solve`: what the step has waited for is no part of its time."""
        ...

    def wait(self) -> Due:
        """Sleeps until the next step is due (real time) and while paused."""
        ...

    def records(self) -> NDArray[np.void]:
        """Returns the step records since the last call, one for each body and step, oldest first."""
        ...

    def factor_matrix(self, body: int) -> Float64:
        """Returns A as last assembled, (blocks, 3, 3), with contacts that a factor is to know; before `solve`."""
        ...

    def records_and_reactions(self) -> tuple[NDArray[np.void], Float64]:
        """Returns the records, and with each the force [N] and torque [N m] on each obstacle, (k, obstacles, 6)."""
        ...

    def other_reactions(self) -> NDArray[np.void]:
        """Returns what bodies exerted on grabs and on each other: struct Reaction of kernels/reaction.h, by step.

        Since the last call, up to the newest record that was returned.
        """
        ...

    def frames(self) -> list[tuple[int, Float64, Float64]]:
        """Returns the frames since the last call: step, x (n, 3) [m] and v (n, 3) [m/s]."""
        ...

    def settings(self, body: int) -> SolveSettings:
        """Returns the solver settings of a body, to be read and set."""
        ...

    def post_factor(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        """Takes a factor of the matrix of `step`, whose values do not change any more; one of the next solves of the
        body takes it up."""
        ...

    def post_factors(self, bodies: Sequence[int], factors: Sequence[Factor]) -> None:
        """Posts factors of different bodies, one of each. Their values do not change any more."""

    def response_function(self) -> int:
        """Address of the function that finds the largest response of factors (inverse/digits.py), for who calls it as
        factors arrive; 0: nobody need."""
        ...

    def planes_by(self, factors: FactorsTogether, responses: Float64) -> list[int] | None:
        """Returns how many float16 numbers an entry the inverse of each factor needs, by its largest response (k,);
        None: not known."""
        ...

    def prepare_together(self, bodies: Sequence[int], factors: FactorsTogether) -> None:
        """Makes ready what it takes to use factors of different bodies, without waiting; each is used once its values
        are posted, else it must be dropped, or is by the next one of its body. From any thread."""
        ...

    def post_together(self, bodies: Sequence[int], factors: FactorsTogether) -> None:
        """Posts factors that came together, as `post_factors`."""

    def prepare_for_factors(self) -> None:
        """Begins what the first factor would wait for, without waiting."""
        ...

    def prepare_factor(self, body: int, factor: Factor, r: Float64) -> Callable[[], Float64 | None] | None:
        """Makes ready what it takes to use a factor, without waiting, and applies it to r (n,) for who checks it. It is
        used once it is posted; else it must be dropped.

        Returns what waits for P^-1 r, and returns None if it comes to nothing; None: a factor needs no preparation.
        """
        ...

    def may_prepare(self, body: int) -> bool:
        """False while a factor of a body before has no step yet, so that another one would have to wait."""
        ...

    def drop_factor(self, body: int, factor: Factor) -> None:
        """Gives up a factor that may have been prepared, and is not posted."""
        ...

    def factor_memory(self, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        """Makes an array for values of a factor, (count,), from which `post_factors` takes them with fewest copies.
        From any thread."""
        ...

    def shared_memory(self) -> SharedMemory | None:
        """Returns device memory that other processes can open; None: there is none."""
        ...

    def expect_factors(self, body: int, pattern: FactorPattern) -> None:
        """Prepares for factors of a pattern that will come, without waiting."""
        ...

    def expects_factors(self) -> bool:
        """True once it is prepared for all factors that will come."""
        ...

    def resume_factor(self, body: int, pattern: FactorPattern, values: NDArray[Any], step: int) -> None:
        """As `post_factor`, of the factor that was in use when the state that was written was saved."""
        ...

    @property
    def substeps(self) -> int:
        """Explicit substeps of the step under way, or of the last one; 0: an implicit scheme, or not known yet."""
        ...

    def settle_factors(self) -> None:
        """Blocks until the next solves will use what was posted."""
        ...

    def factor_step(self, body: int) -> int:
        """Returns the step of the factor in use, -1 without one."""
        ...

    def factor_bytes(self, body: int) -> int:
        """Returns the number of bytes that an application of the newest factor reads, 0 without one."""
        ...

    def correct(
        self, body: int, nodes: int, diagonal: Float64, double: bool = False, block: Float64 | None = None
    ) -> None:
        """Has factors of the body corrected for changes of the diagonal at `nodes` (1 to 64) nodes at most.

        diagonal: (nodes of the scene,) [kg], as assembled. double: for factors in float64. block: (nodes of the scene,
        6), upper triangles of the nodes' own blocks [kg]; None: to be read from A, which every step then has. To be
        called before the first step, and only with LOW_RANK_UPDATE.
        """
        ...

    def request_matrix(self, body: int, target: Float64) -> None:
        """Has the values of the next matrix of the body copied into `target` (blocks, 3, 3)."""
        ...

    def prepare_copies(self) -> None:
        """Makes the memory of copies of matrices, for which the first request would wait."""
        ...

    def copy_memory(self, body: int) -> Float64 | None:
        """Returns memory (blocks, 3, 3) that the loop brings the next matrix of a body to by itself: as target of
        `request_matrix` it saves a copy. The matrix behind that one leaves it alone. None: there is none such."""
        ...

    def request_matrices(self, bodies: Int64) -> tuple[list[Float64], Int64] | None:
        """Does `request_matrix` for the `copy_memory` of each of some bodies, and returns that memory and its
        addresses; None, and does nothing: there is none."""
        ...

    def request_positions(self, body: int, target: Float64, ahead: float = 0.0) -> None:
        """Has positions, `ahead` [s] further along their velocities, copied into `target` (nodes, 3).

        Replaces a request for the matrix, and the other way round. Raises ValueError for an `ahead` above 0 without
        MATRIX_POSITIONS.
        """
        ...

    def matrix_step(self, body: int) -> int:
        """Returns the number of steps completed before the copy requested last was made; -1: it is not there yet."""
        ...

    def matrix_steps(self, bodies: Int64) -> Int64:
        """Returns `matrix_step` of each of some bodies."""
        ...

    def staged_matrix(self, body: int) -> int:
        """Returns where the device has the matrix that was copied last; 0: nowhere, or with other numbers."""
        ...

    def staged_matrices(self, bodies: Int64) -> Int64:
        """Returns `staged_matrix` of each of some bodies."""
        ...

    def replace(self, launch: int, new: Launch) -> PendingUpdate:
        """Gives a mailed launch (its number among `launches`) new arguments, from one of the next steps on."""
        ...

    def stage(self, changes: Sequence[ArrayChange]) -> list[StagedChange]:
        """Makes all memory ready that `change` of these needs; steps see nothing of it. May fail as a build does."""
        ...

    def change(self, changes: Sequence[StagedChange]) -> PendingUpdate:
        """Copies new contents into arrays of the host, or their twins, all between the same two steps.

        Nothing else may wait to be copied: see `withdraw_changes`.
        """
        ...

    def withdraw_changes(self) -> bool:
        """Takes back what `change` was given last and the loop has not taken up; False if there is nothing."""
        ...

    def take_changes(self) -> None:
        """Copies what waits of `change` at once, while the loop stands still between two steps."""
        ...

    def prepare(self) -> None:
        """Makes the state before the first step, which `run` and `assemble` do otherwise."""
        ...

    def state(self) -> list[StateArray]:
        """Returns what steps carry on beside the arrays that launches write."""
        ...

    def resume(self, step: int, start_time: float) -> None:
        """Goes on after `step` steps, once all state arrays were written. start_time [s]: of step 0."""
        ...

    def restart(self, bodies: Sequence[int]) -> None:
        """Begins the energy balances of bodies anew after a reset: with their positions and velocities, none frozen."""
        ...


@dataclass(frozen=True)
class EngineInput:
    """What an engine runs.

    assemble, integrate: launches before and after the solve
    names, ranges: of the bodies, and their nodes [first, last)
    dt: time step [s]
    energies: what the energy of each step is summed from
    newton: for several linearizations a step; None for one
    stages: of a Rosenbrock-W step; None for other schemes
    euler: steps of backward Euler that single bodies take; None: all bodies take those of the scheme
    substeps: explicit substeps that make a step; None: an implicit scheme
    contact: rows that launches among `assemble` fill in; None: nothing can be touched
    touch: the one of `assemble` that pushes and grabs (effects/touch.cu); None: no object lists the effect
    held: (bodies, k, 6) force [N] and torque [N m] on each holder, attachment and spring; None: there are none
    errors: whether the estimated errors of positions are wanted where they cost time
    rank_one: parts of A beside its blocks, on a CPU alone; None: there are none
    arrays: of the system by name: row_start, columns, values, b, y, x, v, clock, moving, rotation
    history: launches that begin every step, once, whatever attempts, trials or stages it takes
    cut: of bodies that may lose elements; None: no object lists the effect
    measured: numbers that records come with, in the order of bodies
    halving: short steps of bodies that ran away; None: these are frozen, or go on
    """

    assemble: Sequence[Launch]
    integrate: Sequence[Launch]
    names: Sequence[str]
    ranges: Sequence[tuple[int, int]]
    dt: float
    solver: SolverOptions
    energies: Energies
    newton: Newton | None
    stages: Rosenbrock | None
    euler: EulerForm | None
    substeps: CentralDifference | None
    contact: Contact | None
    touch: Launch | None
    held: Float64 | None
    errors: bool
    rank_one: RankOne | None
    arrays: Mapping[str, NDArray[Any]]
    history: Sequence[Launch] = ()
    cut: CutInput | None = None
    measured: Sequence[Measured] = ()
    halving: Halving | None = None


@dataclass(frozen=True)
class CutInput:
    """What tells engines which nodes of bodies lost elements, and when.

    bodies: indices of those that may; at_rest, changed_at, free (nodes,): as in effects/cutting.py
    spawn: launch that begins copies of nodes after parameters have changed, None if none are; origin, copied_at
        (nodes,): where they come from and since when, as in effects/cutting_split.cu
    most_blocks: of A of each body of the scene, however it is split; none: the pattern stays
    """

    bodies: Sequence[int]
    at_rest: Float64
    changed_at: Float64
    free: Float64
    spawn: Launch | None = None
    origin: Int32 | None = None
    copied_at: Float64 | None = None
    most_blocks: Sequence[int] = ()


class Backend(Protocol):
    """A device as a place for kernels to run. Arrays are named by those of the host; a GPU has a twin of each."""

    @property
    def name(self) -> str:
        """Name of the device in scenes and logs: cpu or gpu."""
        ...

    def building(self) -> AbstractContextManager[None]:
        """Around the building of a scene: too little memory of the device becomes a DeviceError."""
        ...

    def module(self, path: str) -> Module:
        """Returns a kernel text of this package (path: as of compiler.read_text), compiled once."""
        ...

    def engine(self, given: EngineInput) -> Engine:
        """Returns the loop over launches of this backend."""
        ...

    def build(self) -> str:
        """Returns a digest of what a run depends on beside its scene: equal ones repeat it bit for bit."""
        ...

    def keep(self, *hosts: NDArray[Any], exact: bool = False) -> None:
        """Declares arrays that stay for the whole run. exact: in their type, whatever the precision of the kernels."""
        ...

    def fetch(self, host: NDArray[Any]) -> NDArray[Any]:
        """Returns the array with what kernels have made of it."""
        ...

    def begin_fetch(self, host: NDArray[Any]) -> Future[NDArray[Any]]:
        """Begins to copy what kernels have made of an array, beside the caller, who would wait for as long as another
        thread allocates memory that a GPU reads. The host's array does not change."""
        ...

    def push(self, host: NDArray[Any]) -> None:
        """Gives kernels the array as it is on the host. While the loop stands still."""
        ...

    def view(self, host: NDArray[Any]) -> Any:
        """Returns the memory that kernels use for the array: itself, or on a GPU its twin, a CuPy array."""
        ...

    def settle(self) -> None:
        """Waits for what others have begun on the device, as writes to views. While the loop stands still."""
        ...
