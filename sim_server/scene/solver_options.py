# SPDX-License-Identifier: MIT
"""The [solver] table of a scene."""

import re
from typing import Annotated, Any, Literal, NamedTuple, get_args

from pydantic import Field, PlainSerializer, PlainValidator

from protocol.method import Method
from sim_server.errors import InputError
from sim_server.scene.parameters import Parameters, complaint

Preconditioner = Literal[
    "auto", "none", "jacobi", "block_jacobi", "ssor", "ssor_factor", "incomplete_cholesky", "cholesky"
]
PRECONDITIONERS: tuple[str, ...] = get_args(Preconditioner)
FACTORS = ("cholesky", "incomplete_cholesky", "ssor_factor")  # made by workers, from an older matrix
UpdateText = Annotated[str, Field(pattern=r"^(never|async|adaptive|(every|lockstep)-[1-9][0-9]{0,5})$")]
CPU_ONLY = ("ssor", "ssor_factor", "incomplete_cholesky")  # sweeps and sparse solves are sequential


class Update(NamedTuple):
    """The update policy of factors: kind, and n for every and lockstep.

    never: one factor, made from the first matrix
    every: a factor at each n-th step, which waits for it
    async: made while the simulation runs, used once it is there
    adaptive: as async, but only when the iterations lost to an old factor have cost as much as a new one
    lockstep: as async, but used exactly n steps after the step of its matrix; deterministic
    """

    kind: Literal["never", "every", "async", "adaptive", "lockstep"]
    n: int = 0

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


Rule = Literal["excess", "round_robin"]
Precision = Literal["float64", "mixed", "float32"]
OnRunaway = Literal["freeze", "go_on", "halve"]
FactorPrecision = Literal["auto", "float16", "float32", "float64"]
_ALLOWED: dict[str, dict[str, tuple[str | int, ...]]] = {  # values by option and device
    "preconditioner": {
        "cpu": PRECONDITIONERS,
        "gpu": tuple(p for p in PRECONDITIONERS if p not in CPU_ONLY),
    },
    "precision": {"cpu": ("float64",), "gpu": ("float64", "mixed", "float32")},
    "on_runaway": {"cpu": get_args(OnRunaway), "gpu": ("freeze", "go_on")},
    "factor_precision": {"cpu": ("auto", "float32", "float64"), "gpu": ("auto", "float16", "float32")},
    "gpus": {"cpu": (1,), "gpu": (1, 2)},
}


class SolverOptions(Parameters):
    """Options of the solution of the linear system of a step, and of the updates of its preconditioner."""

    tolerance: float = Field(
        default=1e-6, gt=0, lt=1, description="bound of the true residual: |b - A dv| <= tolerance |b|"
    )
    max_iterations: int = Field(
        default=500, ge=1, le=1_000_000, description="of a solve; then the step goes on with what it has"
    )
    preconditioner: Annotated[
        Preconditioner, PlainValidator(_preconditioner, json_schema_input_type=Preconditioner)
    ] = Field(default="auto", description="of the conjugate gradients; auto: chosen by measurement")
    omega: float = Field(default=1.0, gt=0, lt=2, description="relaxation of ssor and ssor_factor")
    drop_tolerance: float = Field(
        default=0.003, ge=0, lt=1, description="incomplete_cholesky drops blocks of L below this times a row's norm"
    )
    fill: float = Field(
        default=10.0, ge=0, le=1e6, description="incomplete_cholesky: most blocks in a column, over A's; 0 = no bound"
    )
    warp: bool = Field(default=True, description="solve in the material frame")
    warp_level: int = Field(
        default=1, ge=1, le=2, description="rings of neighbours that rotate a node whose elements have no rotation"
    )
    projection: Literal["auto", "excess", "clamp", "absolute", "none"] = Field(
        default="auto", description="treatment of negative eigenvalues of the stiffness of an element"
    )
    update: Annotated[Update, PlainValidator(_update, json_schema_input_type=UpdateText), PlainSerializer(str)] = Field(
        default=Update("async"), description="when factors are made: never, every-N, async, adaptive or lockstep-D"
    )
    first_factor: Literal["wait", "go"] | None = Field(
        default=None, description="a server's first step waits for its own factors or goes; None: waits in real time"
    )
    precision: Precision = Field(
        default="float64", description="of the kernels: mixed = elements in float32, the rest in float64"
    )
    factor_precision: FactorPrecision = Field(
        default="auto",
        description="of the factor as applied; auto: float32 on a CPU, where it is used alone (ros2) and where it does "
        "not bear float16, else float16",
    )
    budget: float = Field(default=0.0, ge=0, description="wall time per solve [s]; 0 = none")
    budget_ms: float | None = Field(default=None, gt=0, description="wall time per step [ms]")
    on_runaway: OnRunaway = Field(
        default="freeze", description="treatment of a body with more energy than accounted for"
    )
    threads: int = Field(default=1, ge=1, le=1024, description="of the simulation on a CPU")
    gpus: int = Field(
        default=1, ge=1, le=2, description="of this host that apply the factors of large bodies, on a GPU"
    )
    warm_start: bool = Field(default=True, description="start from what the last steps' solutions say of this one")
    woodbury: int = Field(
        default=32, ge=0, le=64,
        description="correct factors for grabs and contacts since, of at most this many nodes of an object; 0: off",
    )  # fmt: skip
    build: Literal["server", "worker"] = Field(
        default="server", description="where the matrices to factorize are assembled; worker: positions are sent"
    )
    extrapolate: float = Field(
        default=0.0, ge=0, le=10,
        description="build = worker: x + v t is sent, t the expected time until the factor is used, at most this [s]",
    )  # fmt: skip
    update_floor_iterations: int = Field(
        default=3, ge=0, le=1_000_000, description="iterations above this count as excess"
    )
    update_floor_steps: int = Field(
        default=1, ge=1, le=1_000_000, description="fewest steps between two factors of an object"
    )
    update_threshold: float = Field(
        default=1.0, ge=0, le=1e6,
        description="adaptive: excess iterations must have cost this multiple of the time of a factorization",
    )  # fmt: skip
    schedule: Rule = Field(default="excess", description="rule by which the next object to be factorized is chosen")
    schedule_rounds: float = Field(
        default=8.0, ge=1, le=1e6, description="an object goes next after this many rounds, under any rule"
    )

    @property
    def wants_factors(self) -> bool:
        """True if matrices are sent to be factorized."""
        return self.preconditioner == "auto" or self.preconditioner in FACTORS

    @property
    def has_exact_factors(self) -> bool:
        """True if factors are exact ones, or may be."""
        return self.preconditioner in ("auto", "cholesky")

    @property
    def method(self) -> Method:
        """The method by which factors are made; with "auto", the default of its `choices`."""
        if self.preconditioner == "incomplete_cholesky":
            return self._incomplete
        return Method("ssor", omega=self.omega) if self.preconditioner == "ssor_factor" else Method()

    @property
    def _incomplete(self) -> Method:
        return Method("incomplete_cholesky", drop_tolerance=self.drop_tolerance, fill=self.fill)

    def choices(self, device: str) -> tuple[Method, ...]:
        """Methods that "auto" may choose from on a device, the first one to begin with; empty without "auto".

        The incomplete factor comes first since it is made fastest. On a GPU, and where one factor is made for the whole
        run, only the exact factor is used.
        """
        if self.preconditioner != "auto":
            return ()
        exact = device != "cpu" or self.update.kind == "never"
        return (Method(),) if exact else (self._incomplete, Method())

    def method_named(self, name: str) -> Method:
        """The method of a factor in a log, by name; "": the one of the scene."""
        known = {m.name: m for m in (Method(), self._incomplete)}
        return self.method if self.preconditioner != "auto" else known.get(name, Method())

    @property
    def step_budget(self) -> float:
        """Wall time of a step [s]; 0: any."""
        return (self.budget_ms or 0.0) / 1000

    @property
    def factor_dtype(self) -> Literal["float32", "float64"]:
        """Type of the values of L as sent; the applied factor is made from them."""
        return "float64" if self.factor_precision == "float64" else "float32"

    def check_device(self, device: str) -> None:
        """Raises InputError for options that the device ("cpu" or "gpu") does not have."""
        for field, allowed in _ALLOWED.items():
            value = getattr(self, field)
            if value not in allowed[device]:
                words = ", ".join(repr(a) for a in allowed[device])
                raise InputError(f"solver.{field} = {value!r}: must be one of {words} on a {device.upper()}")
        if self.extrapolate and (self.build != "worker" or device == "gpu"):
            raise InputError(
                f'solver.extrapolate = {self.extrapolate:g}: must be 0 without build = "worker", and on a GPU'
            )
