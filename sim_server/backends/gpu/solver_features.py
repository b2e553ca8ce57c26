# SPDX-License-Identifier: MIT
"""What the solves of a scene do beside the plain iteration: each is part of pcg.cu only where a scene has it."""

from collections.abc import Sequence
from dataclasses import dataclass

from sim_server.backends.base import CutInput
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.correction import FactorCorrection
from sim_server.backends.gpu.cupy_types import DeviceArray
from sim_server.backends.gpu.helper import Helper
from sim_server.backends.gpu.smoothing import FactorSmoothing
from sim_server.backends.gpu.structs import CONTACT, PCG, STAGES


@dataclass(frozen=True)
class SolverFeatures:
    """What the solves of a scene do beside the plain iteration.

    planes: float16 numbers per entry of an inverse; 1, or 2 for 22 bits; None: as each factor needs (digits.py)
    phases: NewtonPhases.of_solves (newton.py); empty: one linearization a step
    attempts: number of solves that the graph of a Rosenbrock-W step holds (stages.cuh); 0: another scheme
    contact: True for a scene with contact (contact_state.cuh)
    between: True if bodies touch each other, or are tied, there (island_state.cuh)
    correction: of factors for grabs and contacts; None: they are not corrected
    errors: True for a scene whose solves estimate the errors of positions (iterate_error.cuh)
    budgets: True for a scene whose solves may end by their wall time (step_budget.cuh); they estimate errors, too
    cut: what tells of nodes that lose elements, and how many blocks A has at most; None: no body can be cut
    smoothing: of factors that are too old; None: they are left as they are
    helper: a second GPU that applies half of the inverses of large bodies
    """

    planes: int | None = 1
    phases: Sequence[DeviceArray] = ()
    attempts: int = 0
    contact: bool = False
    between: bool = False
    correction: FactorCorrection | None = None
    errors: bool = False
    budgets: bool = False
    cut: CutInput | None = None
    smoothing: FactorSmoothing | None = None
    helper: Helper | None = None

    @property
    def most_blocks(self) -> Sequence[int]:
        """Blocks of A of each body at most, where its pattern changes; none: it stays."""
        return self.cut.most_blocks if self.cut else ()

    @property
    def exchanges(self) -> bool:
        """True if no body may be solved as one that exchanges nothing (block_group.cuh)."""
        return bool(
            self.phases or self.attempts or self.between or self.most_blocks or self.smoothing or self.helper
        )  # fmt: skip

    @property
    def declared(self) -> Declarations:
        """Structs that the solver's kernels share with the host."""
        return STAGES if self.attempts else CONTACT if self.contact else PCG

    @property
    def application(self) -> str | None:
        """Kernel that applies factors for solves whose iteration is not in pcg.cu; None: there is none."""
        return "apply_factor" if self.attempts else "island_factor" if self.between else None

    def definitions(self, kernel: str, alone: bool) -> list[str]:
        """Returns the definitions with which the text of a kernel is compiled. alone: SolverLayout.alone"""
        pcg = kernel == "pcg"
        wanted = {
            "NEWTON_PHASES": self.phases, "STAGES": self.attempts, "CONTACT_PASSES": self.contact,
            "CORRECTED": pcg and self.correction, "ERRORS": pcg and self.errors, "BUDGETS": pcg and self.budgets,
            "SMOOTHED": pcg and self.smoothing, "CUTS": pcg and self.cut, "ALONE": pcg and alone,
            "SPLITS": self.most_blocks, "HELPED": pcg and self.helper,
        }  # fmt: skip
        return [f"-D{name}" for name, there in wanted.items() if there]
