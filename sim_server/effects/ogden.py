# SPDX-License-Identifier: MIT
"""Compressible Ogden solid: rubber and brain tissue, by powers of the principal stretches.

With the principal stretches s_1, s_2, s_3 (singular values of F), J = s_1 s_2 s_3 and up to three terms::

    W = sum_p mu_p / alpha_p (J^(-alpha_p/3) (s_1^alpha_p + s_2^alpha_p + s_3^alpha_p) - 3) + bulk/2 ln^2 J

At small strains its shear modulus is 1/2 sum_p mu_p alpha_p and its bulk modulus `bulk`. alpha = [2] is the Neo-Hookean
solid, [2, -2] the Mooney-Rivlin solid. Each mu_p alpha_p must be above 0. `mu` may be a list of regions
{ where, mu, alpha, bulk }.

Forces and stiffness come from U diag(dW/ds) V^T and its closed eigensystem, for every element: it costs about what the
other laws cost where they project. Stretches of an inverted element have no powers: J <= 0 is refused, with no
regularization.

Usual ranges: Ogden's rubber mu = [0.63, 0.0012, -0.01] MPa, alpha = [1.3, 5, -2]; brain mu = [-50 to -500] Pa with
alpha = [-4 to -25] (it stiffens in compression); bulk 10 to 100 times the shear modulus.

Source: Ogden, Large deformation isotropic elasticity - on the correlation of theory and experiment for incompressible
rubberlike solids, Proceedings of the Royal Society A 326, 1972; the eigensystem: Smith, de Goes and Kim 2019.
"""

from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, Field

from sim_server.arrays import Float64
from sim_server.effects._hyperelastic import Constant, Hyperelastic, Law, Values, of_shear_and_bulk
from sim_server.errors import InputError
from sim_server.mechanics.world import Body, World
from sim_server.scene.live import Live
from sim_server.scene.parameters import Positive, complaint

SCOPE = "object"
TERMS = 3


def _terms(value: Any) -> Any:
    if not isinstance(value, (list, tuple)) or not 1 <= len(value) <= TERMS:
        raise complaint(f"must be a list of one to {TERMS} numbers")
    return (*value, *[0.0] * (TERMS - len(value)))


Terms = Annotated[
    tuple[float, float, float],
    BeforeValidator(_terms, json_schema_input_type=Annotated[list[float], Field(min_length=1, max_length=TERMS)]),
]


def pack(values: Values) -> list[Float64]:
    """mu_p, alpha_p and the bulk modulus; terms that are not there have mu = 0 and alpha = 1. Raises InputError."""
    mu, alpha = values["mu"].T, values["alpha"].T
    absent = (mu == 0) & (alpha == 0)
    if (wrong := ~absent & ~(mu * alpha > 0)).any():
        p, e = np.argwhere(wrong)[0]
        raise InputError(
            f"effect ogden: term {p + 1} has mu = {mu[p, e]:g} Pa and alpha = {alpha[p, e]:g}; allowed: as many of one "
            "as of the other, and mu alpha > 0"
        )
    return [*mu, *np.where(absent, 1.0, alpha), values["bulk"]]


LAW = Law(
    "ogden",
    (
        Constant("mu", Terms, "factors of the terms [Pa], one to three, or a list of regions"),
        Constant("alpha", Terms, "exponents of the stretches [-], as many", live=Live()),
        Constant("bulk", Positive, "bulk modulus [Pa]"),
    ),
    pack=pack,
    elastic=lambda values: of_shear_and_bulk(0.5 * (values["mu"] * values["alpha"]).sum(axis=1), values["bulk"]),
    text="effects/ogden.cu",
    regularizes=False,
)
Params = LAW.parameters()


def build(world: World, listed: list[tuple[Body, Any]]) -> Hyperelastic:
    """The elements; raises InputError for an element in no region of mu."""
    return Hyperelastic(world, listed, LAW)
