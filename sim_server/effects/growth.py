# SPDX-License-Identifier: MIT
"""Growth: elements that want another size. Thermal expansion, swelling, growing or shrinking tissue, 4D prints.

Listed beside a law. Each element has a rest shape of its own, stretched along X, Y and Z of the rest coordinates ::

    F = F_e F_g,    F_g = diag(1 + expansion amount)

and the law's energy density is that of F_e, by volume of the grown shape det F_g V: elements whose wishes fit together
grow without stress, others stress each other. `expansion` is a number, or [x, y, z]; `amount` multiplies it, live: so a
coefficient of thermal expansion [1/K] takes a difference of temperature [K], a final strain a part from 0 to 1.
`expansion` may be a list of regions { where, expansion, amount }. 1 + expansion amount must be 0.05 or more.

A bar that is free reaches 1 + expansion amount times its length, one that is clamped along it alone the stress of its
law at the stretch 1 / (1 + expansion amount): E expansion amount if that is small. Masses stay what they are. Forces
and matrix are those of the law, fibres and muscles grow with their elements, and the elastic energy that a change of
`amount` brings counts as work.

It is there for corotational and the hyperelastic laws with linear elements, which objects have then by default.

Usual ranges: expansion of steel 1.2e-5, of rubber 2e-4 1/K; hydrogels swell by 0.1 to 1; the cortex of a brain grows by
0.3 to 1 along its surface.

Source: Rodriguez, Hoger and McCulloch, Stress-dependent finite growth in soft elastic tissues, Journal of Biomechanics
27, 1994 (the product of growth and elastic deformation).
"""

from collections.abc import Callable, Sequence
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator

from sim_server.arrays import Float64
from sim_server.effects._base import Effect
from sim_server.effects._hyperelastic import Constant, Law, constants_of
from sim_server.errors import InputError
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene
from sim_server.scene.elements import LAWS
from sim_server.scene.live import Live
from sim_server.scene.parameters import Vector

SCOPE = "object"
LEAST = 0.05  # stretch of a rest shape
MOST = 100  # likewise, the largest


def _three(value: Any) -> Any:
    """A number as three of it."""
    return (float(value),) * 3 if isinstance(value, (int, float)) and not isinstance(value, bool) else value


LAW = Law(
    "growth",
    (
        Constant("expansion", Annotated[Vector, BeforeValidator(_three, json_schema_input_type=float | Vector)],
                 "strain, or [x, y, z], of an amount of 1 [-], or a list of regions", live=Live()),
        Constant("amount", float, "that expansion is multiplied by: a difference of temperature, or a part [-]", 1.0,
                 live=Live(0, 1)),
    ),
    pack=lambda values: [values["amount"]],
    refuses=False,
)  # fmt: skip
Params = LAW.parameters()


def stretches_of(bodies: Sequence[Body]) -> Callable[[Scene], Float64]:
    """Returns the function of a scene that gives F_g of all elements of bodies, (m, 3); 1 in those that do not grow."""

    def compute(scene: Scene) -> Float64:
        return np.concatenate([_stretches(body, scene) for body in bodies])

    return compute


def _stretches(body: Body, scene: Scene) -> Float64:
    params = scene.objects[body.index].effects.get("growth")
    if params is None:
        return np.ones((len(body.mesh.tets), 3))
    values = constants_of(LAW, body, params)
    stretches = 1 + values["expansion"] * values["amount"][:, None]
    if not ((stretches >= LEAST) & (stretches <= MOST)).all():
        wrong = stretches.min() if stretches.min() < LEAST else stretches.max()
        raise InputError(
            f"object {body.name!r}, effect growth: 1 + expansion amount is {wrong:g}: must be from {LEAST} to {MOST}"
        )
    return stretches


def build(world: World, listed: list[tuple[Body, Any]]) -> Effect:
    """Nothing that runs: the laws ask for stretches_of. Raises InputError for a body without a law that can grow."""
    for body, _ in listed:
        found = [name for name in ("corotational", *LAWS) if name in body.effects]
        if not found or "mass_spring" in body.effects:
            why = "springs do not grow" if found else "it changes the rest shape of a material"
            raise InputError(
                f"object {body.name!r}, effect growth: {why}; list corotational or a hyperelastic law beside it, "
                "and no mass_spring"
            )
    return Effect()
