# SPDX-License-Identifier: MIT
"""Compressible Mooney-Rivlin solid: rubber in tension and shear to strains of about 100 to 200 %.

With J = det F, C = F^T F, I1 = tr C and I2 = (I1^2 - tr C^2) / 2::

    W = c1 (J^-2/3 I1 - 3) + c2 (J^-4/3 I2 - 3) + bulk/2 ln^2 J

At small strains its shear modulus is 2 (c1 + c2) and its bulk modulus `bulk`; c2 = 0 is the Neo-Hookean solid with
shape and volume apart. `c1` may be a list of regions { where, c1, c2, bulk }.

Powers and logarithm of J are not defined at J <= 0: see `inversion` in _hyperelastic.py.

Usual ranges: rubber c1 = 0.1 to 0.5 MPa and c2 = 0 to 0.2 MPa (the ratio c2 / c1 from 0 to 1), liver and kidney c1 and
c2 of some 100 to 1000 Pa; bulk from 10 times the shear modulus (a Poisson's ratio of 0.45) to 100 times (0.495); linear
tetrahedra lock towards the upper end.

Source: Mooney, A theory of large elastic deformation, 1940; Rivlin, Large elastic deformations of isotropic materials
IV, 1948; with the isochoric invariants of Holzapfel, Nonlinear Solid Mechanics, 2000, section 6.5.
"""

from typing import Any

from sim_server.effects._hyperelastic import Constant, Hyperelastic, Law, hyperelastic, of_shear_and_bulk
from sim_server.mechanics.world import Body, World
from sim_server.scene.parameters import NotNegative, Positive

SCOPE = "object"
LAW = Law(
    "mooney_rivlin",
    (
        Constant("c1", Positive, "factor of the first isochoric invariant [Pa], or a list of regions"),
        Constant("c2", NotNegative, "factor of the second isochoric invariant [Pa]"),
        Constant("bulk", Positive, "bulk modulus [Pa]"),
    ),
    pack=lambda values: [values["c1"], values["c2"], values["bulk"]],
    elastic=lambda values: of_shear_and_bulk(2 * (values["c1"] + values["c2"]), values["bulk"]),
    volumetric=2,
)
Params = LAW.parameters()


def build(world: World, listed: list[tuple[Body, Any]]) -> Hyperelastic:
    """The elements; raises InputError for an element in no region of c1."""
    return hyperelastic(LAW, world, listed)
