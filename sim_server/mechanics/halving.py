# SPDX-License-Identifier: MIT
"""The launches of short steps, by which the step of a body that ran away is made again (`on_runaway = "halve"`).

Short steps are those of backward Euler with one linearization, whatever the scheme: no other loses so much of the
energy that should not be there. Loads, pushes and grabs are as at the start of the whole step.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.backends.halving import Halving
from sim_server.errors import InputError
from sim_server.mechanics.integrator import CouplesNodes, Integrator
from sim_server.mechanics.world import World

HALVINGS = 4  # at most


def time_steps(world: World) -> list[float]:
    """Returns the short time steps [s], the longest one first."""
    return [world.dt / 2**k for k in range(1, HALVINGS + 1)]


def halving(
    integrator: Integrator, assemble: Sequence[Sequence[Launch]], advance: Sequence[Launch],
    effects: Sequence[CouplesNodes], exerted: Iterable[Float64], touched: Int32 | None,
) -> Halving:  # fmt: skip
    """Returns the input of an engine.

    assemble, advance: launches of each time step. exerted: arrays (nodes, 3) and (nodes,) of what acts on nodes from
    outside, which the energy balance reads. touched: `only` of pushes and grabs
    """
    w, s = integrator.world, integrator.system
    scheme = [] if w.plain else [w.predictor, w.damping_velocity, integrator.inertial_increment]
    end = None if w.plain else integrator.advance_euler()
    listed = [*(x for launches in assemble for x in launches), *advance, *([] if end is None else [end])]
    return Halving(
        assemble=assemble, advance=advance, end=end, parts=integrator.parts_of(listed, effects),
        coefficients=w.coefficients, before=integrator.before, rotation=s.rotation, scheme=scheme,
        left=[w.x, w.v, s.dv, integrator.before, *scheme, *exerted],
        touched=np.full(1, -1, np.int32) if touched is None else touched,
    )  # fmt: skip


def check_memory(histories: Iterable[tuple[str, Sequence[Launch]]]) -> None:
    """Raises InputError for materials that remember, whose memory advances once a step.

    histories: names of effects and their launches
    """
    for name, launches in histories:
        if launches:
            raise InputError(
                f'solver.on_runaway = "halve" with the effect {name}, whose memory advances by whole steps; allowed: '
                '"freeze", "go_on"'
            )
