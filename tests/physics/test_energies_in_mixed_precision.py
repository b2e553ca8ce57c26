# SPDX-License-Identifier: MIT
"""Energies of elements in mixed precision are those of double precision, also of elements that hardly strain.

There F is the identity but for strains near float32's rounding, so I1 - 3, S - I or l - l0 in float32 is mostly that
rounding, and in a stiff element it is large beside the energy of soft ones. The texts are built with the types that a
GPU has in mixed precision (tests/texts.py).
"""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.kernel_binding import members_of
from sim_server.effects._base import Effect
from sim_server.simulation import Simulation
from tests.hard_cases.models import MODELS, MODELS_BAR
from tests.texts import mixed

MEMBRANE = "object.bar.effects.membrane={ young = 1e6, poisson = 0.4, thickness = 1e-3, prestretch = 1.001 }"
STEEL = "object.bar.effects.rod={ path = [[0.5, 0.5, 0], [0.5, 0.5, 4]], young = 2e11, radius = 1e-3, density = 7850 }"
SCENES = {name: model.overrides() for name, model in MODELS.items()} | {
    name: (*MODELS["mass_spring"].overrides(), more) for name, more in (("membrane", MEMBRANE), ("rod", STEEL))
}
STRAINED = 1e-6  # m: moves of nodes, in elements of 0.5 m


def energies(effect: Effect) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Of each element: in mixed precision, and in double precision of the same rounded constants [J]."""
    elements = effect.energies()
    assert elements is not None
    launch, single, double = elements.launch, {}, {}
    members = members_of(launch.text, launch.struct, {"real": "double", "local": "float"})
    for member, value in zip(members, launch.values, strict=True):
        single[member.name] = double[member.name] = value
        if member.dtype == np.float32:
            single[member.name] = np.asarray(value, np.float32)
            double[member.name] = single[member.name].astype(np.float64)
    count, kernel = single.pop("n"), launch.name.split(".")[-1]
    del double["n"]
    mixed(launch.module.path).bind(kernel, count, **single)()
    launch.module.bind(kernel, count, **double)()
    return single["energy"].astype(np.float64), double["energy"]


@pytest.mark.parametrize("name", SCENES)
def test_an_element_has_the_energy_of_its_strain(name: str) -> None:
    sim = Simulation.load(MODELS_BAR, list(SCENES[name]))
    sim.world.x += STRAINED * np.random.default_rng(0).normal(size=sim.world.x.shape)
    found = [energies(effect) for effect in sim.effects.values() if effect.energies() is not None]
    assert found
    for single, double in found:
        assert np.abs(double).max() > 0 and np.abs(single - double).max() < 1e-5 * np.abs(double).max()
