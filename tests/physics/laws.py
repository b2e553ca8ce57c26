# SPDX-License-Identifier: MIT
"""The hyperelastic laws as the tests go through them: what a scene says, and the reference's energy."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.simulation import Simulation
from tests.reference import hyperelastic as reference
from tests.scenes import bar, jittered_bar, mesh_file, simulation

SIZE = (1.5, 1.0, 0.8)
ELASTIC = {"young": 3e4, "poisson": 0.35}


@dataclass(frozen=True)
class Law:
    """table: of the effect; W: its energy by the reference; inverts: defined at J <= 0.

    beside: another effect in the object, and its energy.
    """

    name: str
    table: dict[str, Any]
    W: Callable[..., Any]
    inverts: bool = False
    beside: dict[str, Any] = field(default_factory=dict)
    other: Callable[..., Any] | None = None


MOONEY = {"c1": 5e3, "c2": 3e3, "bulk": 6e4}
CHAINS = {"shear": 1e4, "segments": 3.0, "bulk": 6e4}
SKIN = {"c1": 4e3, "c2": 2.5, "bulk": 6e4}
OGDEN = {"mu": [6e3, 400.0, -800.0], "alpha": [1.3, 5.0, -2.0], "bulk": 6e4}
HEART = {"ff": 18.5, "fs": 4.8, "fn": 2.8, "ss": 3.58, "sn": 3.8, "nn": 6.58}


def axes_of(fibre: list[float], sheet: list[float]) -> NDArray[np.float64]:
    """Columns f, s, n."""
    f = np.array(fibre) / np.linalg.norm(fibre)
    s = np.array(sheet) - f * (f @ np.array(sheet))
    s /= np.linalg.norm(s)
    return np.column_stack([f, s, np.cross(f, s)])


REGULARIZED = {"inversion": "regularize", "floor": 0.4}
LAWS = {
    "st_venant_kirchhoff": Law("st_venant_kirchhoff", ELASTIC, partial(reference.st_venant_kirchhoff, **ELASTIC), True),
    "neo_hookean": Law("neo_hookean", ELASTIC, partial(reference.neo_hookean, **ELASTIC)),
    "neo_hookean, regularized": Law(
        "neo_hookean", ELASTIC | REGULARIZED, partial(reference.regularized_neo_hookean, floor=0.4, **ELASTIC), True
    ),
    "mooney_rivlin": Law("mooney_rivlin", MOONEY, partial(reference.mooney_rivlin, **MOONEY)),
    "mooney_rivlin, regularized": Law(
        "mooney_rivlin", MOONEY | REGULARIZED, partial(reference.regularized_mooney_rivlin, floor=0.4, **MOONEY), True
    ),
    "arruda_boyce": Law("arruda_boyce", CHAINS, partial(reference.arruda_boyce, **CHAINS)),
    "veronda_westmann": Law("veronda_westmann", SKIN, partial(reference.veronda_westmann, **SKIN)),
    "ogden": Law("ogden", OGDEN, partial(reference.ogden, **OGDEN)),
    "costa": Law(
        "costa",
        {
            "a": 880.0,
            "bulk": 4e4,
            "fibre": [1, 0.3, 0.2],
            "sheet": [0, 2, -1],
            **{f"b_{k}": b for k, b in HEART.items()},
        },
        partial(reference.costa, a=880.0, b=HEART, bulk=4e4, axes=axes_of([1, 0.3, 0.2], [0, 2, -1])),
    ),
    "fibres": Law(
        "fibres",
        {"stiffness": 4e4, "exponent": 0.2, "direction": [[1, 0.3, 0.2], [0, 2, -1]]},
        partial(reference.fibres, stiffness=4e4, exponent=0.2, directions=np.array([[1, 0.3, 0.2], [0, 2, -1]])),
        True,
        {"stable_neo_hookean": ELASTIC},
        partial(reference.stable_neo_hookean, **ELASTIC),
    ),
    "stable_neo_hookean": Law("stable_neo_hookean", ELASTIC, partial(reference.stable_neo_hookean, **ELASTIC), True),
}


def law_bar(law: Law | str, mesh: Any = None, table: dict[str, Any] | None = None, **scene: Any) -> Simulation:
    """A bar of this law. mesh: its table; keywords of tests.scenes.bar and of the solver go there."""
    name = law if isinstance(law, str) else law.name
    keys = ("cells", "size", "fixed", "damping", "density", "touch", "elements")
    body = {k: scene.pop(k) for k in keys if k in scene}
    table = table or (law.table if isinstance(law, Law) else ELASTIC)
    o = bar(young=None, **({"mesh": mesh} if mesh else {}), **body)
    o["effects"][name] = table
    if isinstance(law, Law):
        o["effects"] |= law.beside
    return simulation(o, **scene)


def odd_bar(folder: Path, law: Law | str, cells: tuple[int, int, int] = (2, 1, 1), **scene: Any) -> Simulation:
    """A bar of unequal elements, all nodes free."""
    return law_bar(law, mesh_file(folder, *jittered_bar(cells, SIZE, seed=2)), **scene)


def elements(sim: Simulation) -> Any:
    """The effect that has the elements."""
    return next(e for e in sim.effects.values() if e.elements is not None)


def determinants(sim: Simulation) -> NDArray[np.float64]:
    """J of every element."""
    corners, rest = (a[elements(sim).elements] for a in (sim.world.x, sim.world.rest))
    now, then = (np.linalg.det(c[:, 1:] - c[:, :1]) for c in (corners, rest))
    return now / then


def deform(sim: Simulation, size: float, seed: int = 0) -> None:
    """Moves the nodes at random by about `size` times an edge and gives them velocities; with size 0.6 some elements
    of a law that allows it are inverted."""
    random = np.random.default_rng(seed)
    sim.world.x += 0.5 * size * random.normal(size=sim.world.x.shape)
    sim.world.v[:] = random.normal(size=sim.world.v.shape)


def forces(sim: Simulation) -> NDArray[np.float64]:
    """Forces by the kernels: b / h of an undamped body, with its velocity set to zero."""
    sim.world.v[:] = 0
    sim.engine.assemble()
    return sim.system.b / sim.world.dt


def stiffness(sim: Simulation) -> NDArray[np.float64]:
    """(3 n, 3 n) from the kernels, of a body without fixed nodes, in the world's frame."""
    sim.engine.assemble()
    n = sim.world.nodes
    A = sim.matrix().toarray().reshape(n, 3, n, 3)
    A = np.einsum("aik,akbl,bjl->aibj", sim.system.rotation, A, sim.system.rotation).reshape(3 * n, 3 * n)
    return (A - np.diag(np.repeat(sim.world.mass, 3))) / sim.world.dt**2


def reference_system(sim: Simulation, law: Law, projection: str = "none") -> tuple[float, NDArray, NDArray]:
    """Energy, forces (n, 3) and stiffness (3 n, 3 n) by the reference."""
    x, rest = sim.world.x, sim.world.rest
    energy, f, K = 0.0, np.zeros(x.size), np.zeros((x.size, x.size))
    energies = [law.W] if law.other is None else [law.W, law.other]  # each is projected by itself
    if projection == "excess" and law.name == "costa":  # not isotropic: its modes mix stretches and twists
        projection = "absolute"
    for W, tet in ((W, tet) for W in energies for tet in elements(sim).elements):
        energy_e, f_e, K_e = reference.element(W, x[tet], rest[tet], projection)
        dofs = (3 * tet[:, None] + np.arange(3)).ravel()
        energy += energy_e
        f[dofs] += f_e.ravel()
        K[np.ix_(dofs, dofs)] += K_e
    return energy, f.reshape(-1, 3), K


def error_of_forces(sim: Simulation) -> float:
    """Relative, against the slope of the energy."""
    x, slope, step = sim.world.x, np.zeros_like(sim.world.x), 1e-5
    for k in np.ndindex(*x.shape):
        at, energy = x[k], []
        for x[k] in (at + step, at - step, at + 2 * step, at - 2 * step):
            energy.append(sim.potential_energy())
        x[k] = at
        slope[k] = (8 * (energy[0] - energy[1]) - (energy[2] - energy[3])) / (12 * step)
    f = forces(sim).copy()
    return float(np.abs(f + slope).max() / np.abs(f).max())


def error_of_stiffness(sim: Simulation) -> float:
    """Relative, against the slope of the forces."""
    x = sim.world.x
    K, change, step = stiffness(sim), np.zeros((x.size, x.size)), 1e-6
    for j, k in enumerate(np.ndindex(*x.shape)):
        at = x[k]
        x[k] = at + step
        above = forces(sim).ravel().copy()
        x[k] = at - step
        change[:, j] = (above - forces(sim).ravel()) / (2 * step)
        x[k] = at
    return float(np.abs(K + change).max() / np.abs(K).max())
