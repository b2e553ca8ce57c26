# SPDX-License-Identifier: MIT
"""The files of materials: their form, their order, and that our laws give what their sources published."""

import re
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from pydantic import BaseModel, ConfigDict, Field, model_validator
from scipy.optimize import brentq

from protocol import materials
from sim_server import effects
from sim_server.scene.materials import ELASTIC
from tests.reference import hyperelastic as reference

Text = Annotated[str, Field(min_length=5)]
Positive = Annotated[float, Field(gt=0)]
Constants = dict[str, float | list[float]]


class Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


class Source(Table):
    text: Text
    doi: Annotated[str, Field(pattern=r"^10\.\d{4,9}/\S+$")] | None = None
    url: Annotated[str, Field(pattern=r"^https://\S+$")] | None = None

    @model_validator(mode="after")
    def _one_address(self) -> "Source":
        assert (self.doi is None) != (self.url is None)
        return self


class Modulus(Table):
    of: Literal["young", "shear", "aggregate"]
    low: Positive | None = None
    typical: Positive
    high: Positive | None = None


class Curve(Table):
    at: Literal["low", "typical", "high"]
    error: Annotated[float, Field(gt=0, le=0.2)]
    points: list[list[float]]


class File(Table):
    title: Text
    kind: Literal["silicone", "rubber", "gel", "tissue"]
    condition: Text
    stretch: Annotated[list[Positive], Field(min_length=2, max_length=2)]
    density: Annotated[float, Field(gt=100, lt=2000)]
    density_source: Text
    law: Literal[ELASTIC]  # type: ignore[valid-type]
    chosen: Text
    low: Constants | None = None
    typical: Constants
    high: Constants | None = None
    modulus: Modulus | None = None
    source: Annotated[list[Source], Field(min_length=1)]
    curve: list[Curve] = []

    def places(self) -> list[str]:
        return [place for place in materials.PLACES if getattr(self, place) is not None]


def files() -> list[tuple[str, File]]:
    return [(name, File.model_validate(materials.read(name))) for name in materials.names()]


EACH = pytest.mark.parametrize(("name", "file"), files(), ids=materials.names())


def young_and_poisson(law: str, constants: Constants) -> tuple[float, float]:
    """At small strains, by the effect's own formula."""
    if law == "corotational":
        return constants["young"], constants["poisson"]  # type: ignore[return-value]
    params = effects.effect(law).Params.model_validate(constants)
    values = {key: np.array([value]) for key, value in params.model_dump().items() if not isinstance(value, str)}
    young, poisson = effects.effect(law).LAW.elastic(values)
    return float(young[0]), float(poisson[0])


def uniaxial(law: str, constants: Constants, stretch: float) -> float:
    """Nominal stress [Pa] of a cube that is stretched with free sides, by the energy of the reference."""
    energy = partial(getattr(reference, law), **constants)

    def stress(side: float) -> Any:
        return reference.stress(energy, np.diag([stretch, side, side]).astype(float))

    free = brentq(lambda side: stress(side)[1, 1], 0.5 * stretch**-0.5, 1.5 * stretch**-0.5)
    return float(stress(free)[0, 0])


@EACH
def test_sources_and_constants(name: str, file: File) -> None:
    assert any(source.doi for source in file.source)
    assert file.modulus or file.curve, "nothing published to compare with"
    assert {curve.at for curve in file.curve} <= set(file.places())
    for place in file.places():
        assert effects.effect(file.law).Params.model_validate(getattr(file, place))
        assert list(getattr(file, place)) == list(file.typical)


@EACH
def test_low_is_below_typical_and_high_above(name: str, file: File) -> None:
    young = [young_and_poisson(file.law, getattr(file, place))[0] for place in file.places()]
    assert young == sorted(young) and len(set(young)) == len(young)


@EACH
def test_the_modulus_at_small_strains_is_that_of_the_source(name: str, file: File) -> None:
    if file.modulus is None:
        return
    for place in file.places():
        E, nu = young_and_poisson(file.law, getattr(file, place))
        of = {"young": E, "shear": E / (2 * (1 + nu)), "aggregate": E * (1 - nu) / ((1 + nu) * (1 - 2 * nu))}
        assert of[file.modulus.of] == pytest.approx(getattr(file.modulus, place), rel=1e-3)


@EACH
def test_the_chosen_poissons_ratio_is_that_of_the_constants(name: str, file: File) -> None:
    said = re.findall(r"0\.\d+", file.chosen)
    for place in file.places():
        assert not said or young_and_poisson(file.law, getattr(file, place))[1] == pytest.approx(
            float(said[0]), abs=1e-4
        )


@EACH
def test_curves_are_the_published_ones_within_their_error(name: str, file: File) -> None:
    """Within the range of stretches, or next to its end."""
    for curve in file.curve:
        largest = max(abs(stress) for _, stress in curve.points)
        for stretch, stress in curve.points:
            assert file.stretch[0] <= stretch <= 1.01 * file.stretch[1]
            ours = uniaxial(file.law, getattr(file, curve.at), stretch)
            assert ours == pytest.approx(stress, abs=curve.error * largest), (curve.at, stretch)


def test_a_convention_with_two_mu_over_alpha_squared_would_be_found() -> None:
    """Ogden's constants in the other convention have a shear modulus of sum mu: the curve tells them apart."""
    file = dict(files())["dragon_skin_30"]
    mu, alpha = file.typical["mu"][0], file.typical["alpha"][0]  # type: ignore[index]
    wrong = file.typical | {"mu": [mu * alpha / 2]}
    stretch, stress = file.curve[0].points[-1]
    assert abs(uniaxial("ogden", wrong, stretch) / stress - 1) > 3 * file.curve[0].error
