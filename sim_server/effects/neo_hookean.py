# SPDX-License-Identifier: MIT
"""Compressible Neo-Hookean solid: rubber and soft tissue at large strains.

Energy density and first Piola-Kirchhoff stress, with J = det F and I1 = tr F^T F::

    W = mu/2 (I1 - 3) - mu ln J + lambda/2 ln^2 J
    P = mu (F - F^-T) + lambda ln J F^-T

lambda = E nu / ((1 + nu) (1 - 2 nu)) and mu = E / (2 (1 + nu)): at small strains it is Hooke's law for `young` and
`poisson`, which may differ by region (`young` as a list of tables { where, young, poisson }). In tension it softens
(E = 1, nu = 0.45: P = 0.599 at twice the length), in compression it stiffens without bound.

poisson below 0 is refused: lambda ln^2 J with a negative lambda has no lower bound.

ln J is not defined at J <= 0: see `inversion` in _hyperelastic.py. For scenes that turn elements inside out,
stable_neo_hookean costs the same and is defined everywhere.

Usual ranges: young 1e3 Pa (brain, liver) to 1e7 Pa (rubber), poisson 0.3 to 0.49; from 0.49 on linear tetrahedra lock.
Strains to about 100 %; rubber at larger ones stiffens, which this law does not show (see mooney_rivlin, arruda_boyce).

Source: Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd edition, 2008, section 6.4.3.
"""

from typing import Annotated, Any

from pydantic import AfterValidator, Field

from sim_server.effects._hyperelastic import (
    Hyperelastic,
    Law,
    hyperelastic,
    lame,
    young_and_poisson,
    young_and_poisson_of,
)
from sim_server.mechanics.world import Body, World
from sim_server.scene.parameters import complaint

SCOPE = "object"


def _not_auxetic(poisson: float) -> float:
    if poisson < 0:
        raise complaint(
            "must be 0 or more: below, lambda is negative, and the energy falls without bound where an element is "
            "pressed flat; corotational, st_venant_kirchhoff and stable_neo_hookean take such a material"
        )
    return poisson


LAW = Law(
    "neo_hookean",
    young_and_poisson_of(Annotated[float, Field(lt=0.5), AfterValidator(_not_auxetic)]),
    pack=lame,
    elastic=young_and_poisson,
    volumetric=0,
)
Params = LAW.parameters()


def build(world: World, listed: list[tuple[Body, Any]]) -> Hyperelastic:
    """The elements; raises InputError for an element in no region of young."""
    return hyperelastic(LAW, world, listed)
