# SPDX-License-Identifier: MIT
"""Compressible Veronda-Westmann solid: skin, and soft tissue that stiffens exponentially.

With J = det F, C = F^T F, I1 = tr C and I2 = (I1^2 - tr C^2) / 2::

    W = c1 (exp(c2 (J^-2/3 I1 - 3)) - 1) - c1 c2 / 2 (J^-4/3 I2 - 3) + bulk/2 ln^2 J

At small strains its shear modulus is c1 c2 and its bulk modulus `bulk`; c2 says from what strain on it stiffens (about
1 / sqrt(c2)). `c1` may be a list of regions { where, c1, c2, bulk }.

Powers and logarithm of J are not defined at J <= 0: see `inversion` in _hyperelastic.py. The exponential grows fast: at
c2 = 10 and three times the length it is exp(40); a force that is no finite number ends the solve with not_finite.

Usual ranges: c1 = 1 Pa to 5 kPa, c2 = 1 to 20, bulk 10 to 100 times c1 c2.

Source: Veronda and Westmann, Mechanical characterization of skin - finite deformations, Journal of Biomechanics 3(1),
1970.
"""

from typing import Any

from sim_server.effects._hyperelastic import Constant, Hyperelastic, Law, hyperelastic, of_shear_and_bulk
from sim_server.mechanics.world import Body, World
from sim_server.scene.live import Live
from sim_server.scene.parameters import Positive

SCOPE = "object"
LAW = Law(
    "veronda_westmann",
    (
        Constant("c1", Positive, "factor of the exponential [Pa], or a list of regions"),
        Constant("c2", Positive, "factor in the exponent [-]", live=Live(0.1, 10, logarithmic=True, relative=True)),
        Constant("bulk", Positive, "bulk modulus [Pa]"),
    ),
    pack=lambda values: [values["c1"], values["c2"], values["bulk"]],
    elastic=lambda values: of_shear_and_bulk(values["c1"] * values["c2"], values["bulk"]),
    volumetric=2,
)
Params = LAW.parameters()


def build(world: World, listed: list[tuple[Body, Any]]) -> Hyperelastic:
    """The elements; raises InputError for an element in no region of c1."""
    return hyperelastic(LAW, world, listed)
