# SPDX-License-Identifier: MIT
"""The standard scenes of the benchmark, and overrides of their keys as `sim-server --set KEY=VALUE` takes them."""

from dataclasses import dataclass, field, replace
from pathlib import Path

from sim_server.errors import InputError
from sim_server.scene import load
from tests.bench.harness.schemes import SCENES

HERE = Path(__file__).parent
Settings = dict[str, str]  # values by key

USUAL: Settings = {
    "solver.preconditioner": "cholesky", "solver.update": "lockstep-4", "solver.max_iterations": "100000",
}  # fmt: skip
EXPLICIT: Settings = {"integrator.scheme": "central_difference"}
NEWTON: Settings = {"integrator.linearizations": "50", "integrator.tolerance": "1e-10", "solver.tolerance": "1e-10"}


@dataclass(frozen=True)
class Case:
    """A scene with one object. dt [s]: of its file; seconds: that are simulated; length [m]: what errors are told over.

    cells: of its mesh, a bar; law: its elasticity; laws: others with the same constants; explicit: explicit substeps
    are short enough to make references; contact: steps are of backward Euler; settled: a step goes to
    equilibrium; exact: what an exactly solved step needs
    beside NEWTON; positions [m]: bounds of the error of a step; always: overrides of
    a small run.
    """

    name: str
    file: Path
    object: str
    length: float
    dt: float
    seconds: float
    cells: tuple[int, int, int]
    law: str
    constants: str
    laws: tuple[str, ...] = ()
    explicit: bool = False
    contact: bool = False
    settled: bool = False
    positions: tuple[str, ...] = ("1e-2", "1e-3", "1e-4")
    exact: Settings = field(default_factory=dict, hash=False)
    always: Settings = field(default_factory=dict, hash=False)

    def meshed(self, cells: tuple[int, int, int]) -> dict[str, str]:
        """With another mesh."""
        return {f"object.{self.object}.mesh.bar": str(list(cells))}

    def with_law(self, law: str) -> dict[str, str]:
        """With another law of elasticity, and the same constants."""
        if law == self.law:
            return {}
        effects = f"object.{self.object}.effects"
        return {f"{effects}.{self.law}": "false", f"{effects}.{law}": self.constants}

    def stepped(self, dt: float) -> dict[str, str]:
        """With another time step [s]."""
        return {} if dt == self.dt else {"dt": f"{dt:.12g}"}


BEAM = Case(
    "beam", SCENES / "beam.toml", "beam", 4.0, 0.02, 1.2, (5, 5, 20), "corotational",
    "{ young = 1e6, poisson = 0.45 }", ("stable_neo_hookean", "st_venant_kirchhoff"), explicit=True,
)  # fmt: skip
BANDS = Case(
    "heterogeneous beam", SCENES / "heterogeneous.toml", "beam", 4.2, 0.02, 1.2, (5, 5, 21), "corotational",
    "{ poisson = 0.4, young = [{ where = 'Z < 1.4', young = 5e6 }, { where = 'Z < 2.8', young = 2.5e5 }, "
    "{ young = 5e4 }] }", ("stable_neo_hookean",),
)  # fmt: skip
RUBBER = Case(
    "neo-Hookean beam", HERE / "neo_hookean.toml", "beam", 4.0, 0.02, 1.2, (5, 5, 20), "stable_neo_hookean",
    "{ young = 1e6, poisson = 0.45 }", ("corotational", "st_venant_kirchhoff"), explicit=True,
)  # fmt: skip
FLOOR = Case(
    "block on a floor", HERE / "on_floor.toml", "block", 0.2, 0.01, 0.5, (8, 4, 8), "corotational",
    "{ young = 1e4, poisson = 0.4 }", ("stable_neo_hookean",), contact=True, positions=("1e-4", "1e-5", "1e-6"),
    exact={"effects.contact.tolerance": "1e-9", "effects.contact.passes": "200"},
)  # fmt: skip
ROLLERS = Case(
    "block on rollers", HERE / "on_rollers.toml", "block", 4.0, 1.0, 1.0, (8, 1, 32), "corotational",
    "{ young = 1e6, poisson = 0.3 }", settled=True,
)  # fmt: skip
CASES = (BEAM, BANDS, RUBBER, FLOOR)
SMALL = replace(BEAM, seconds=0.2, cells=(2, 2, 8), always=BEAM.meshed((2, 2, 8)))  # for a smoke run


def overrides(case: Case, settings: Settings) -> list[str]:
    """As the command line has them."""
    return [f"{key}={value}" for key, value in (case.always | settings).items()]


def accepts(case: Case, settings: Settings) -> bool:
    """Whether the scene takes these keys."""
    try:
        load(case.file, overrides(case, settings))
    except InputError:
        return False
    return True


def damped_by(case: Case, settings: Settings) -> Settings | None:
    """What a reference needs to damp as these settings do: the tangent, where the stiffness damps.

    Damping of the stiffness is by the tangent of corotational elements, which schemes choose. None: as the scene with
    several linearizations does, which references have.
    """
    body = load(case.file, overrides(case, settings)).objects[0]
    damping, law = body.effects.get("rayleigh"), body.effects.get("corotational")
    if damping is None or law is None or not getattr(damping, "stiffness", 0.0):
        return None
    tangent = str(getattr(law, "tangent", ""))
    return None if tangent == "usual" else {f"object.{case.object}.effects.corotational.tangent": tangent}


def usual(*more: Settings) -> dict[str, str]:
    """USUAL and others; without a preconditioner where there is nothing to solve."""
    together: dict[str, str] = {}
    for one in (USUAL, *more):
        together |= one
    if together.get("integrator.scheme") == EXPLICIT["integrator.scheme"]:
        together = {key: value for key, value in together.items() if not key.startswith("solver.")}
        together["solver.preconditioner"] = "none"
    return together
