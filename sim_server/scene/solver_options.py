# SPDX-License-Identifier: MIT
"""The [solver] table of a scene."""

import re
from typing import Annotated, Any, Literal, NamedTuple, get_args

from pydantic import Field, PlainSerializer, PlainValidator

from protocol.method import Method
from sim_server.errors import InputError
from sim_server.scene.parameters import Parameters, complaint
from sim_server.schedule import Rule

Preconditioner = Literal[
    "auto", "none", "jacobi", "block_jacobi", "ssor", "ssor_factor", "incomplete_cholesky", "cholesky"
]
PRECONDITIONERS: tuple[str, ...] = get_args(Preconditioner)
FACTORS = ("cholesky", "incomplete_cholesky", "ssor_factor")  # made elsewhere, from an older matrix
CPU_ONLY = ("ssor", "ssor_factor", "incomplete_cholesky")  # sweeps and sparse solves follow one row after another


class Update(NamedTuple):
    """When a factor is renewed: kind and n (0 for never and async).

    never: made once, from the first matrix. every: made at each n-th step, the step waiting for it.
    async: made beside the simulation, adopted when it comes. adaptive: as async, but only when the iterations lost to
    an old factor have cost as much as a new one. lockstep: as async, but adopted exactly n steps after the step that
    its matrix is from; deterministic.
    """

    kind: Literal["never", "every", "async", "adaptive", "lockstep"]
    n: int = 0

    @property
    def free(self) -> bool:
        """Nothing ever waits for a factor: the loop runs by itself."""
        return self.kind in ("async", "adaptive")

    def __str__(self) -> str:
        return f"{self.kind}-{self.n}" if self.kind in ("every", "lockstep") else self.kind


def _update(value: Any) -> Update:
    if isinstance(value, Update):
        return value
    if value in ("never", "async", "adaptive"):
        return Update(value)
    if isinstance(value, str) and (match := re.fullmatch(r"(every|lockstep)-([1-9][0-9]{0,5})", value)):
        return Update(match[1], int(match[2]))  # type: ignore[arg-type]  # one of two words by the pattern
    raise complaint(
        'must be "never", "async", "adaptive", "every-N" or "lockstep-D" with a whole number of steps, as "every-30"'
    )


def _preconditioner(value: Any) -> str:
    if isinstance(value, str) and value in PRECONDITIONERS:
        return value
    raise complaint(f"must be one of {', '.join(PRECONDITIONERS)}")


Precision = Literal["float64", "mixed", "float32"]
OnRunaway = Literal["freeze", "go_on"]
FactorPrecision = Literal["auto", "float16", "float32", "float64"]
_ONLY: dict[str, dict[str, tuple[str, ...]]] = {  # what the devices have
    "preconditioner": {
        "cpu": PRECONDITIONERS,
        "gpu": tuple(p for p in PRECONDITIONERS if p not in CPU_ONLY),
    },
    "precision": {"cpu": ("float64",), "gpu": ("float64", "mixed", "float32")},
    "factor_precision": {"cpu": ("auto", "float32", "float64"), "gpu": ("auto", "float16", "float32")},
}


class Solver(Parameters):
    """How each step's linear system is solved."""

    tolerance: float = Field(default=1e-6, gt=0, lt=1, description="of the true residual: |b - A dv| <= tolerance |b|")
    max_iterations: int = Field(default=500, ge=1, le=1_000_000)
    preconditioner: Annotated[Preconditioner, PlainValidator(_preconditioner)] = "auto"
    omega: float = Field(default=1.0, gt=0, lt=2, description="relaxation of ssor and ssor_factor")
    drop_tolerance: float = Field(
        default=0.003, ge=0, lt=1, description="of a row's norm; incomplete_cholesky leaves out smaller blocks of L"
    )
    fill: float = Field(
        default=10.0, ge=0, le=1e6, description="most blocks of a column of incomplete_cholesky, in A's; 0 = no bound"
    )
    warp: bool = Field(default=True, description="solve in the material frame")
    warp_level: int = Field(
        default=1, ge=1, le=2, description="neighbours that give a node its rotation where its elements have none"
    )
    projection: Literal["auto", "excess", "clamp", "absolute", "none"] = Field(
        default="auto", description="what becomes of negative eigenvalues of an element's stiffness"
    )
    update: Annotated[Update, PlainValidator(_update), PlainSerializer(str)] = Update("async")
    precision: Precision = Field(
        default="float64", description="of the kernels: mixed = elements in float32, the rest in float64"
    )
    factor_precision: FactorPrecision = Field(
        default="auto", description="of the factor as applied; auto: float16 on a GPU, float32 on a CPU"
    )
    budget: float = Field(default=0.0, ge=0, description="wall time per solve [s]; 0 = none")
    on_runaway: OnRunaway = Field(
        default="freeze", description="what becomes of a body with more energy than it can have come by"
    )
    threads: int = Field(default=1, ge=1, le=1024)
    warm_start: bool = Field(default=True, description="start from the last step's dv")
    woodbury: int = Field(
        default=32, ge=0, le=64,
        description="on a CPU: factors are corrected for grabs begun or ended since, of at most so many nodes; 0: none",
    )  # fmt: skip
    build: Literal["server", "worker"] = Field(
        default="server", description="who assembles the matrices to factorize; worker: it is sent positions"
    )
    extrapolate: float = Field(
        default=0.0, ge=0, le=10,
        description="build = worker: positions go out as x + v t, t what a factor is expected to take, at most so [s]",
    )  # fmt: skip
    update_floor_iterations: int = Field(
        default=3, ge=0, le=1_000_000, description="iterations above this count as excess"
    )
    update_floor_steps: int = Field(
        default=1, ge=1, le=1_000_000, description="fewest steps between two factors of an object"
    )
    update_threshold: float = Field(
        default=1.0, ge=0, le=1e6,
        description="adaptive: excess iterations must have cost so many times what a factorization takes",
    )  # fmt: skip
    schedule: Rule = Field(default="excess", description="whose matrix is factorized next")
    schedule_rounds: float = Field(
        default=8.0, ge=1, le=1e6, description="an object goes next after so many rounds, whatever the rule"
    )

    @property
    def wants_factors(self) -> bool:
        """Matrices go out to be factorized."""
        return self.preconditioner == "auto" or self.preconditioner in FACTORS

    @property
    def method(self) -> Method:
        """What is made of a matrix; "auto": unless it chooses another of its `choices`."""
        if self.preconditioner == "incomplete_cholesky":
            return self._incomplete
        return Method("ssor", omega=self.omega) if self.preconditioner == "ssor_factor" else Method()

    @property
    def _incomplete(self) -> Method:
        return Method("incomplete_cholesky", drop_tolerance=self.drop_tolerance, fill=self.fill)

    def choices(self, device: str) -> tuple[Method, ...]:
        """Methods that "auto" may choose from on a device, the one to begin with first; empty without "auto".

        The incomplete factor is the first to come. It is for CPUs, and one that is made once and for ever is exact.
        """
        if self.preconditioner != "auto":
            return ()
        exact = device != "cpu" or self.update.kind == "never"
        return (Method(),) if exact else (self._incomplete, Method())

    def method_named(self, name: str) -> Method:
        """That of a factor in a log; "": the scene's."""
        known = {m.name: m for m in (Method(), self._incomplete)}
        return self.method if self.preconditioner != "auto" else known.get(name, Method())

    @property
    def factor_dtype(self) -> Literal["float32", "float64"]:
        """Of the values of L on the wire; what is applied is made from them."""
        return "float64" if self.factor_precision == "float64" else "float32"

    def check_device(self, device: str) -> None:
        """Raises InputError for what the device ("cpu" or "gpu") does not have."""
        for field, allowed in _ONLY.items():
            value = getattr(self, field)
            if value not in allowed[device]:
                words = ", ".join(repr(a) for a in allowed[device])
                raise InputError(f"solver.{field} = {value!r}: must be one of {words} on a {device.upper()}")
        if self.extrapolate and (self.build != "worker" or device == "gpu"):
            raise InputError(
                f'solver.extrapolate = {self.extrapolate:g}: must be 0 without build = "worker", and on a GPU'
            )
        if device == "gpu" and self.budget:
            raise InputError(
                f"solver.budget = {self.budget:g}: must be 0 on a GPU, which bounds a solve by max_iterations"
            )
