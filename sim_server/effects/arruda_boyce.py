# SPDX-License-Identifier: MIT
"""Compressible Arruda-Boyce solid (eight chains): rubber up to where its molecules are drawn straight.

Chains of `segments` = N rigid links along the diagonals of a cube; with J = det F and I1 = tr F^T F, the first five
terms of the series of the inverse Langevin function::

    W = shear sum_i a_i / N^(i-1) (J^(-2i/3) I1^i - 3^i) + bulk/2 ln^2 J
    a = 1/2, 1/20, 11/1050, 19/7000, 519/673750

The chains lock at the stretch sqrt(N). At small strains the shear modulus is somewhat above `shear`,
2 sum_i i a_i 3^(i-1) / N^(i-1) times it (1.09 at N = 8), and the bulk modulus is `bulk`. `shear` may be a list of
regions { where, shear, segments, bulk }.

Powers and logarithm of J are not defined at J <= 0: see `inversion` in _hyperelastic.py.

Usual ranges: rubber shear 0.2 to 1 MPa with segments 5 to 50 (Treloar's natural rubber: 0.27 MPa, 26.5); soft tissue
shear 100 Pa to 10 kPa with segments 2 to 10; bulk 10 to 100 times the shear modulus.

Source: Arruda and Boyce, A three-dimensional constitutive model for the large stretch behavior of rubber elastic
materials, Journal of the Mechanics and Physics of Solids 41(2), 1993.
"""

from typing import Annotated, Any

from pydantic import Field

from sim_server.arrays import Float64
from sim_server.effects._hyperelastic import Constant, Hyperelastic, Law, Values, hyperelastic, of_shear_and_bulk
from sim_server.mechanics.world import Body, World
from sim_server.scene.live import Live
from sim_server.scene.parameters import Positive

SCOPE = "object"
SERIES = (1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750)


def small_strains(values: Values) -> tuple[Float64, Float64]:
    """Young's modulus and Poisson's ratio; the shear modulus is 2 dW/dI1 at rest."""
    n = values["segments"]
    shear = 2 * values["shear"] * sum(i * a * (3 / n) ** (i - 1) for i, a in enumerate(SERIES, 1))
    return of_shear_and_bulk(shear, values["bulk"])


LAW = Law(
    "arruda_boyce",
    (
        Constant("shear", Positive, "n k T of the chains [Pa], or a list of regions"),
        Constant("segments", Annotated[float, Field(gt=1)], "links of a chain [-]", live=Live(2, 50, logarithmic=True)),
        Constant("bulk", Positive, "bulk modulus [Pa]"),
    ),
    pack=lambda values: [values["shear"], values["segments"], values["bulk"]],
    elastic=small_strains,
    volumetric=2,
)
Params = LAW.parameters()


def build(world: World, listed: list[tuple[Body, Any]]) -> Hyperelastic:
    """The elements; raises InputError for an element in no region of shear."""
    return hyperelastic(LAW, world, listed)
