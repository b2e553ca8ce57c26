# SPDX-License-Identifier: MIT
"""`bench verification`: every law against differences of its own energy, the patch test, and uniaxial tests."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from sim_server.simulation import Simulation
from tests.bench.verification.row import Row, absolute, relative
from tests.physics.laws import (
    ELASTIC,
    LAWS,
    Law,
    deform,
    error_of_forces,
    error_of_stiffness,
    forces,
    law_bar,
    odd_bar,
)  # fmt: skip
from tests.physics.test_law_answers import AFFINE, UNIAXIAL, cube, pulled
from tests.scenes import interior, jittered_bar, mesh_file, rotation

DIFFERENCES = "central differences of our own energy and forces"


@dataclass(frozen=True)
class At:
    """A law at random positions: rest times `stretch`, turned, each node moved by about `size` times half an edge."""

    law: Law
    where: str
    size: float
    stretch: float = 1.0
    force: bool = True
    stiffness: bool = True


COROTATIONAL, EXACT, QR = (
    Law("corotational", ELASTIC | more, lambda: None, True) for more in ({}, {"tangent": "exact"}, {"rotation": "qr"})
)
SPRINGS = Law("mass_spring", {"young": 3e4}, lambda: None, True)
OTHERS = [  # where the tangent leaves something out, only where it does not matter (corotational.py, mass_spring.py)
    ("corotational", At(COROTATIONAL, "strains of 0.15", 0.15, stiffness=False)),
    ("corotational", At(COROTATIONAL, "some elements inverted", 0.6, stiffness=False)),
    ("corotational", At(COROTATIONAL, "turned, no strain", 0, force=False)),
    ("corotational, exact tangent", At(EXACT, "under tension", 0.02, 1.3)),
    ("corotational, qr", At(QR, "turned, no strain", 0, force=False)),
    ("mass_spring", At(SPRINGS, "strains of 0.15", 0.15, stiffness=False)),
    ("mass_spring", At(SPRINGS, "some elements inverted", 0.6, stiffness=False)),
    ("mass_spring", At(SPRINGS, "under tension", 0.02, 1.4)),
]
TURN = rotation((1, 2, -1), 2.0)


def placed(at: At) -> Simulation:
    """A bar of unequal elements there."""
    with tempfile.TemporaryDirectory() as folder:
        sim = odd_bar(Path(folder), at.law, projection="none")
    sim.world.x[:] = at.stretch * sim.world.rest @ TURN.T
    deform(sim, at.size, seed=2)
    return sim


def slopes(quick: bool) -> list[Row]:
    """Forces of every law, and the stiffness where it is meant to be exact."""
    cases = [
        (name, At(law, "some elements inverted", 0.6) if law.inverts else At(law, "strains of 0.15", 0.15))
        for name, law in list(LAWS.items())[:: 5 if quick else 1]
    ]
    rows = []
    for name, at in cases + OTHERS:
        sim = placed(at)
        if at.force:
            off = error_of_forces(sim)
            rows.append(Row(f"{name}: force, {at.where}", 0, off, off, 1e-6, DIFFERENCES))
        if at.stiffness:
            off = error_of_stiffness(sim)
            rows.append(Row(f"{name}: stiffness, {at.where}", 0, off, off, 1e-5, DIFFERENCES))
    return rows


def patch(quick: bool) -> list[Row]:
    """Largest force inside an affine displacement, over the largest outside."""
    size, worst = (1.2, 1.0, 0.8), 0.0
    for law in list(LAWS.values())[:: 5 if quick else 1]:
        with tempfile.TemporaryDirectory() as folder:
            sim = law_bar(law, mesh_file(Path(folder), *jittered_bar((3, 3, 3), size, seed=1)))
        inside = interior(sim.world.rest, size)
        sim.world.x[:] = sim.world.rest @ AFFINE.T
        f = np.abs(forces(sim))
        worst = max(worst, float(f[inside].max() / f.max()))
    return [Row("patch test, all laws: force inside over force outside", 0, worst, worst, 1e-12, "exact")]


def uniaxial(quick: bool) -> list[Row]:
    rows, sim = [], cube("neo_hookean", 1.0, 0.45)
    for along, (across, stress) in list(UNIAXIAL.items())[:: 3 if quick else 1]:
        found = float(brentq(lambda s, a=along: pulled(sim, a, s)[1], 0.3, 2.0, xtol=1e-13))
        case, source = f"neo_hookean, E = 1, ν = 0.45, stretch {along:g}", "roots of P22 = 0, solved apart, six digits"
        rows.append(absolute(f"{case}: lateral stretch", across, found, 1e-6, source))
        rows.append(absolute(f"{case}: P11", stress, pulled(sim, along, found)[0], 1e-6, source))
    sim = cube("st_venant_kirchhoff", 1.0, 0.0)
    least = minimize_scalar(
        lambda s: pulled(sim, s, 1.0)[0], bounds=(0.2, 0.9), method="bounded", options={"xatol": 1e-8}
    )
    source = "P = E s (s² - 1) / 2 is least at 1/√3"
    rows.append(relative("st_venant_kirchhoff: stretch of the largest pressure", 3**-0.5, least.x, 1e-4, source))
    rows.append(relative("st_venant_kirchhoff: that pressure over E", -(27**-0.5), least.fun, 1e-4, source))
    return rows
