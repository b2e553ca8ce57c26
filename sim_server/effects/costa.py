# SPDX-License-Identifier: MIT
"""Costa's orthotropic solid: heart muscle, with fibres in sheets.

With the strain E = (F^T F - I) / 2 in the axes f (along the fibres), s (across them in the sheet) and n (normal to the
sheet), and J = det F::

    W = a/2 (exp(Q) - 1) + bulk (J ln J - J + 1)
    Q = b_ff E_ff^2 + b_ss E_ss^2 + b_nn E_nn^2 + 2 b_fs E_fs^2 + 2 b_fn E_fn^2 + 2 b_sn E_sn^2

`fibre` and `sheet` are directions in the coordinates of the rest shape, before the pose; they need no unit length, and
what `sheet` has along `fibre` is taken off. `a` may be a list of regions { where, a, ..., fibre, sheet }: that is how
fibres turn through a wall.

ln J is not defined at J <= 0, which is refused; there is no regularization. Negative eigenvalues of the stiffness are
projected by the eigensystem of the 9x9 matrix d2W/dF2 of those elements that have any (kernels/eigen9.cuh).

Usual ranges: heart muscle a = 0.2 to 2 kPa, b_ff = 10 to 40, b_ss and b_nn = 2 to 20, b_fs, b_fn and b_sn = 2 to 12
(defaults: 18.5, 3.58, 3.58, 2.8, 2.8, 2.8 with a = 0.88 kPa); bulk 10 to 1000 kPa.

Source: Costa, Holmes and McCulloch, Modelling cardiac mechanical properties in three dimensions, Philosophical
Transactions of the Royal Society A 359, 2001; constants and volume term: Usyk, Mazhari and McCulloch, Effect of laminar
orthotropic myofiber architecture on regional stress and strain in the canine left ventricle, Journal of Elasticity 61,
2000.
"""

from typing import Any

import numpy as np

from sim_server.arrays import Float64
from sim_server.effects._hyperelastic import Constant, Hyperelastic, Law, Values
from sim_server.errors import InputError
from sim_server.mechanics.world import Body, World
from sim_server.scene.live import Live
from sim_server.scene.parameters import NotNegative, Positive, Vector

SCOPE = "object"
PAIRS = ("ff", "fs", "fn", "ss", "sn", "nn")
STIFFEST = {"ff": 18.5, "fs": 2.8, "fn": 2.8, "ss": 3.58, "sn": 2.8, "nn": 3.58}


def axes(values: Values) -> Float64:
    """(m, 3, 3), columns f, s, n; raises InputError where fibre and sheet are parallel or zero."""
    fibre, sheet = values["fibre"], values["sheet"]
    normal = np.cross(fibre, sheet)
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    if not (size > 1e-9 * np.linalg.norm(fibre, axis=1, keepdims=True) * np.linalg.norm(sheet, axis=1)[:, None]).all():
        raise InputError("effect costa: fibre and sheet must be two directions, neither zero nor parallel")
    f, n = fibre / np.linalg.norm(fibre, axis=1, keepdims=True), normal / size
    return np.stack([f, np.cross(n, f), n], axis=2)


LAW = Law(
    "costa",
    (
        Constant("a", Positive, "factor of the exponential [Pa], or a list of regions"),
        *(Constant(f"b_{k}", NotNegative, f"factor of E_{k}^2 in the exponent [-]", STIFFEST[k]) for k in PAIRS),
        Constant("bulk", Positive, "factor of J ln J - J + 1 [Pa]"),
        Constant("fibre", Vector, "direction of the fibres at rest, before the pose", live=Live()),
        Constant("sheet", Vector, "a direction in the sheet, across the fibres", live=Live()),
    ),
    pack=lambda values: [values["a"], *(values[f"b_{k}"] for k in PAIRS), values["bulk"]],
    axes=axes,
    text="effects/costa.cu",
    regularizes=False,
)
Params = LAW.parameters()


def build(world: World, listed: list[tuple[Body, Any]]) -> Hyperelastic:
    """The elements; raises InputError for an element in no region of a."""
    return Hyperelastic(world, listed, LAW)
