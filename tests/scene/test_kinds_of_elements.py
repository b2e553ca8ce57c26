# SPDX-License-Identifier: MIT
"""Which elements a body has where its scene names none."""

import importlib
from typing import Any

import pytest

from sim_server.scene.elements import LAWS, PATCHED
from sim_server.simulation import Simulation
from tests.scenes import bar, scene

LAW = {"young": 1e5, "poisson": 0.4}


def kind(effects: dict[str, Any], integrator: dict[str, Any] | None = None, **table: Any) -> str:
    given = {**bar((2, 1, 1), **table), "elements": "auto", "effects": effects}
    return Simulation(scene(given, integrator=integrator)).world.bodies[0].elements


@pytest.mark.parametrize("scheme", ["backward_euler", "newmark", "ros2", "quasi_static"])
def test_corotational_bodies_have_smoothed_ones(scheme: str):
    assert kind({"corotational": LAW, "fixed": {"where": "X < 0.01"}}, {"scheme": scheme}) == "smoothed"


@pytest.mark.parametrize(
    ("effects", "integrator"),
    [({"neo_hookean": LAW}, None), ({"mass_spring": {"young": 1e5}}, None), ({}, None),
     ({"corotational": LAW | {"rotation": "qr"}}, None), ({"corotational": LAW}, {"scheme": "central_difference"})],
)  # fmt: skip
def test_where_there_are_no_others_they_are_linear(effects: dict[str, Any], integrator: dict[str, Any] | None):
    assert kind(effects, integrator) == "linear"


def test_laws_whose_elements_may_be_patches_are_those_with_a_part_of_volume():
    laws = {name: importlib.import_module(f"sim_server.effects.{name}").LAW for name in LAWS}
    assert {name for name, law in laws.items() if law.volumetric is not None} == set(PATCHED)
