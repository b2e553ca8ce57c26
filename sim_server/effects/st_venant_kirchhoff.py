# SPDX-License-Identifier: MIT
"""St Venant-Kirchhoff solid: Hooke's law between the Green-Lagrange strain and the second Piola-Kirchhoff stress.

With E = (F^T F - I) / 2::

    W = lambda/2 tr^2 E + mu E : E,   P = F (lambda tr E I + 2 mu E)

lambda = E nu / ((1 + nu) (1 - 2 nu)) and mu = E / (2 (1 + nu)): Hooke's law for `young` and `poisson` at small strains
and exact for any rotation. `young` may be a list of regions { where, young, poisson }.

Good for large rotations with strains of a few per cent: thin beams, plates. In compression it is wrong: the force of a
bar pressed to 1/sqrt(3) = 0.577 of its length is the largest that it can bear (0.19245 E per area), and beyond that it
falls to zero at J = 0. There the stiffness is indefinite, and `[solver] projection` makes it semi-definite. The law is
defined for inverted elements, which have another rest shape: the mirrored one.

W is nowhere negative for any poisson from -1 to 0.5, both exclusive.

Usual ranges: as of corotational, which at small strains gives the same and does not collapse.

Source: Ciarlet, Mathematical Elasticity I, 1988, section 4.4; Bonet and Wood 2008, section 6.3.
"""

from typing import Any

from sim_server.effects._hyperelastic import YOUNG_AND_POISSON, Hyperelastic, Law, lame, young_and_poisson
from sim_server.mechanics.world import Body, World

SCOPE = "object"
LAW = Law(
    "st_venant_kirchhoff",
    YOUNG_AND_POISSON,
    pack=lame,
    elastic=young_and_poisson,
    refuses=False,
)
Params = LAW.parameters()


def build(world: World, listed: list[tuple[Body, Any]]) -> Hyperelastic:
    """The elements; raises InputError for an element in no region of young."""
    return Hyperelastic(world, listed, LAW)
