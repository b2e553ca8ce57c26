# SPDX-License-Identifier: MIT
"""The [integrator] table of a scene."""

from typing import Literal, NamedTuple

from pydantic import Field, model_validator

from sim_server.errors import InputError
from sim_server.scene.parameters import Parameters, complaint

MAX_STATES = 1024  # tried in a step on a GPU whose graphs have no loops, so that they hold them all
SchemeName = Literal[
    "backward_euler", "newmark", "bdf2", "generalized_alpha", "quasi_static", "ros2", "central_difference"
]
GAMMA = 0.29289321881345247559915563789515  # 1 - 1 / sqrt 2, of ros2 (mechanics/rosenbrock.py)
SPECTRAL_RADIUS = 0.5  # of generalized_alpha: with more, undamped bodies may run away from violent starts


class AlphaParameters(NamedTuple):
    """Parameters of the generalized-alpha method [-] (mechanics/generalized_alpha.py)."""

    alpha_m: float
    alpha_f: float
    beta: float
    gamma: float


class IntegratorOptions(Parameters):
    """The scheme of time integration, and the linearizations and line search of a step."""

    scheme: SchemeName = Field(default="backward_euler", description="of time integration")
    beta: float | None = Field(default=None, gt=0, le=1, description="of Newmark's scheme [-]; default 1/4")
    gamma: float | None = Field(default=None, ge=0.5, le=1, description="of Newmark's scheme [-]; default 1/2")
    spectral_radius: float | None = Field(
        default=None, ge=0, le=1,
        description=f"of generalized_alpha, at infinite frequency [-]; default {SPECTRAL_RADIUS}",
    )  # fmt: skip
    linearizations: int = Field(default=1, ge=1, le=1000, description="most of them in a step; above 1: Newton-Raphson")
    tolerance: float = Field(
        default=1e-4, gt=0, lt=1, description="of Newton-Raphson: nonlinear residual over the first |b| of the step"
    )
    trials: int = Field(default=8, ge=0, le=100, description="most shorter steps that a line search tries; 0: none")

    solve: Literal["auto", "factor", "iterate"] = Field(
        default="auto", description="of ros2: by the factor alone where it will do, or always by iterations"
    )
    error_bound: float | None = Field(
        default=None, gt=0, description="of ros2: largest error of a step [m]; default a tenth of the shortest edge"
    )

    @model_validator(mode="after")
    def _of_ros2(self) -> "IntegratorOptions":
        if self.scheme != "ros2":
            given = ["solve"] * (self.solve != "auto") + ["error_bound"] * (self.error_bound is not None)
            if given:
                raise complaint(f"{' and '.join(given)} belong to scheme ros2, not to {self.scheme}")
        elif self.linearizations > 1:
            raise complaint(
                f"ros2 with linearizations = {self.linearizations}: its order does not depend on the matrix, so it has "
                "no use for more; allowed: 1"
            )
        if self.explicit and self.linearizations > 1:
            raise complaint(
                f"{self.scheme} with linearizations = {self.linearizations}: it solves no equations; allowed: 1"
            )
        return self

    @model_validator(mode="after")
    def _stable(self) -> "IntegratorOptions":
        if self.scheme != "newmark":
            if given := [name for name in ("beta", "gamma") if getattr(self, name) is not None]:
                raise complaint(f"{' and '.join(given)} belong to scheme newmark, not to {self.scheme}")
            return self
        beta, gamma = self.newmark
        if 2 * beta < gamma:
            raise complaint(
                f"newmark with beta = {beta:g}, gamma = {gamma:g} is stable for small steps only; "
                "allowed: 1/2 <= gamma <= 2 beta"
            )
        return self

    @model_validator(mode="after")
    def _of_generalized_alpha(self) -> "IntegratorOptions":
        if self.scheme != "generalized_alpha" and self.spectral_radius is not None:
            raise complaint(f"spectral_radius belongs to scheme generalized_alpha, not to {self.scheme}")
        return self

    @property
    def explicit(self) -> bool:
        """True if a step consists of explicit substeps (mechanics/central_difference.py)."""
        return self.scheme == "central_difference"

    @property
    def needs_stiff_matrix(self) -> bool:
        """True if the energy grows unless the stiffness in A is at least the slope of the forces (integrator.py)."""
        return self.scheme in ("newmark", "bdf2", "generalized_alpha") and self.linearizations == 1

    @property
    def newmark(self) -> tuple[float, float]:
        """Newmark's beta and gamma [-]."""
        return (0.25 if self.beta is None else self.beta, 0.5 if self.gamma is None else self.gamma)

    @property
    def alpha(self) -> AlphaParameters:
        """Parameters of generalized_alpha (Chung and Hulbert 1993, eq. 17, 18, 25)."""
        rho = SPECTRAL_RADIUS if self.spectral_radius is None else self.spectral_radius
        alpha_m, alpha_f = (2 * rho - 1) / (1 + rho), rho / (1 + rho)
        return AlphaParameters(alpha_m, alpha_f, (1 - alpha_m + alpha_f) ** 2 / 4, 0.5 - alpha_m + alpha_f)

    def force_coefficient(self, dt: float) -> float:
        """Coefficient i [s] of the forces in M (v' - V) = i f (integrator.py); 1 of an explicit scheme."""
        if self.scheme == "newmark":
            return self.newmark[1] * dt
        if self.scheme == "generalized_alpha":
            a = self.alpha
            return a.gamma * (1 - a.alpha_f) / (1 - a.alpha_m) * dt
        if self.scheme == "ros2":
            return GAMMA * dt
        if self.explicit:
            return 1.0
        return 2 * dt / 3 if self.scheme == "bdf2" else dt

    def dx_dv(self, dt: float) -> float:
        """Derivative c = dx / dv [s] of positions by velocities at the end of the step (integrator.py).

        0 of an explicit scheme.
        """
        if self.explicit:
            return 0.0
        if self.scheme == "newmark":
            beta, gamma = self.newmark
            return beta * dt / gamma
        if self.scheme == "generalized_alpha":
            return self.alpha.beta * dt / self.alpha.gamma
        return self.force_coefficient(dt)

    @property
    def balance_point(self) -> float:
        """Part of a step after which the forces balance [-] (mechanics/generalized_alpha.py); 1 in other schemes."""
        return 1 - self.alpha.alpha_f if self.scheme == "generalized_alpha" else 1.0

    @property
    def rounds(self) -> int:
        """Largest number of states that a step tries: each linearization and the shorter steps of its line search."""
        return self.linearizations * (1 + self.trials)

    def check_unrolled(self) -> None:
        """Raises InputError for more trials than fit into a step on a GPU whose graphs have no loops."""
        if self.rounds > MAX_STATES:
            raise InputError(
                f"integrator.linearizations = {self.linearizations} with trials = {self.trials}: a step on this GPU "
                f"holds them all, {self.rounds}, since the driver is older than CUDA 12.4; allowed: linearizations * "
                f"(1 + trials) up to {MAX_STATES}"
            )
