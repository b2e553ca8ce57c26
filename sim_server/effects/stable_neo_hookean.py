# SPDX-License-Identifier: MIT
"""Stable Neo-Hookean solid: defined for any deformation, also flat and inverted, and driven back from there.

With J = det F, I1 = tr F^T F and constants m, l::

    W = m/2 (I1 - 3) - m/2 ln((I1 + 1) / 4) + l/2 (J - a)^2 - l/2 (1 - a)^2,   a = 1 + 3 m / (4 l)
    P = m (1 - 1 / (I1 + 1)) F + l (J - a) cof F

(the constants make W zero at rest). With m = 4/3 mu and l = lambda + 5/6 mu, where lambda = E nu / ((1 + nu) (1 - 2
nu)) and mu = E / (2 (1 + nu)), it is Hooke's law for `young` and `poisson` at small strains. `young` may be a list of
regions { where, young, poisson }. Unlike the forms without the logarithm, W has no minimum where an element has shrunk
to a point.

Take it for scenes that press, twist or throw bodies about until elements turn over; where none do, neo_hookean resists
compression more (its energy is infinite at J = 0, this one's is not).

From states with many inverted elements, at poisson 0.45 and above, one linearization a step with clamped eigenvalues
overshoots without end; the default projection does not (_hyperelastic.py). Without contact a body may come to rest
folded through itself, no element inverted; several linearizations a step (`[integrator]`) bring more of them back.

Usual ranges: young 1e3 Pa (brain, liver) to 1e7 Pa (rubber), poisson 0.3 to 0.49; from 0.49 on linear tetrahedra lock.

poisson may be as low as -0.8: from about -0.85 on a body shrunk to some six tenths of its size is at rest, too.

Source: Smith, de Goes and Kim, Stable Neo-Hookean Flesh Simulation, ACM Transactions on Graphics 37(2), 2018.
"""

from typing import Annotated, Any

from pydantic import Field

from sim_server.arrays import Float64
from sim_server.effects._hyperelastic import (
    Hyperelastic,
    Law,
    Values,
    hyperelastic,
    lame,
    young_and_poisson,
    young_and_poisson_of,
)
from sim_server.mechanics.world import Body, World

SCOPE = "object"


def pack(values: Values) -> list[Float64]:
    """l and m [Pa], so that the law is Hooke's at small strains."""
    lam, mu = lame(values)
    return [lam + 5 / 6 * mu, 4 / 3 * mu]


AUXETIC = Annotated[float, Field(ge=-0.8, lt=0.5)]
LAW = Law(
    "stable_neo_hookean",
    young_and_poisson_of(AUXETIC),
    pack=pack,
    elastic=young_and_poisson,
    refuses=False,
    volumetric=0,
)
Params = LAW.parameters()


def build(world: World, listed: list[tuple[Body, Any]]) -> Hyperelastic:
    """The elements; raises InputError for an element in no region of young."""
    return hyperelastic(LAW, world, listed)
