# SPDX-License-Identifier: MIT
"""Holders ([[holder]]): groups of nodes that move as rigid bodies, as the scene or a client says.

A held node i is at x_i(t) = start_i + u(t) + (R(t) - 1) arm_i, with arm_i = start_i - center. Its dv is known, so it
is no unknown of the solve: its rows and columns leave A as those of fixed nodes do (fixed.py), and the columns times dv
go to the right-hand side, b_f -= A_fc dv_c. That costs no iterations, and A stays symmetric positive definite. The
product is made by the elements: they get, for the velocity of a held node, the one that has dv_c in it (`hold` in
kernels/holders.cu). With several linearizations a held node is where the step ends before the first of them, in the
generalized-alpha method where its forces balance.

In a step by stages (mechanics/rosenbrock.py) a held node goes straight, at its mean velocity V and acceleration a; the
columns of A times theta (V + beta a), and times the opposite, go to the right-hand sides of the two stages. Without
these terms, which stand for dF/dt in the Jacobian, stiff bodies would overshoot.

The force on a held node is what its own equation lacks, i F_c = A_cf dv_f + A_cc dv_c - b_c, so that momentum is kept
to rounding; in a step by stages what the mean of the forces of both lacks, to second order. The energy balance counts
its work.

Sources: Hughes, The Finite Element Method, section 1.10 (prescribed boundary values).
"""

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch, Module
from sim_server.backends.state import rows_in
from sim_server.effects._movable import Movable, pose_of
from sim_server.errors import InputError
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import World
from sim_server.scene import where
from sim_server.scene.holders import Holder

TEXT = "kernels/holders.cu"


class Stages(Protocol):
    """What holders need of a scheme with stages (mechanics/rosenbrock.py): arrays of its nodes."""

    inertial_increment: Float64
    beta: Float64
    share: Float64
    weight: Float64
    estimate: Float64


class Holders(Movable):
    """All holders of a scene. It is made before the effects of objects, which ask which nodes are free.

    node (n,): held nodes, holder by holder, ascending; holders in the order of their bodies. holder (n,): of each
    first, last (holders,): where those of each begin and end
    force (n, 3): on each node in the last step [N]. They are summed to world.reaction, torques about centres
    load (nodes, 3): the array `force` of the energy balance, of the effect touch where the scene has it
    """

    name = "holders"

    def __init__(self, world: World):
        holders: Sequence[Holder] = world.holders
        masks = []
        for h in holders:
            masks.append(_mask(world, h))
            world.held[masks[-1]] = 1
        self._bodies = [world.body(h.object) for h in holders]
        order = sorted(range(len(holders)), key=lambda k: self._bodies[k].index)
        self.node = np.concatenate([np.flatnonzero(masks[k]) for k in order]).astype(np.int32)
        self.holder = np.repeat(np.array(order, np.int32), [int(masks[k].sum()) for k in order])
        self.first = np.array([np.flatnonzero(self.holder == k)[0] for k in range(len(holders))], np.int32)
        self.last = self.first + np.array([int(m.sum()) for m in masks], np.int32)
        world.held_nodes = self.node
        self.start = world.x[self.node]
        means = [self.start[self.holder == k].mean(axis=0) for k in range(len(holders))]
        self.center = np.array([mean if h.center is None else h.center for h, mean in zip(holders, means, strict=True)])
        super().__init__(world, "holder", holders, [_frames(h, c) for h, c in zip(holders, self.center, strict=True)])
        self.arm = self.start - self.center[self.holder]
        self.ball[:, 3] = -1
        world.free[self.node] = 0
        n = len(self.node)
        self.next, self.later, self.velocity, self.force = self.start.copy(), *(np.zeros((n, 3)) for _ in range(3))
        columns = world.reaction.shape[1]
        self._place = np.array([b.index * columns + k for k, b in enumerate(self._bodies)], np.int32)
        self.load, self._own_load = np.zeros((world.nodes, 3)), True
        self._settled = np.full(n, -1.0)
        self._shift, self._sum, self.moves = np.zeros((n, 3)), np.zeros((n, 3)), world.held_moves
        exact = [a for a in vars(self).values() if isinstance(a, np.ndarray) and a is not self.load]
        world.backend.keep(*exact, exact=True)
        world.backend.keep(self.load)

    def rows_of_bodies(self, array: NDArray[Any]) -> Callable[[int], Any] | None:
        nodal = (self.next, self.later, self.velocity, self.force, self._shift, self._sum, self._settled)
        return rows_in(self.world.body_of(self.node)) if any(array is each for each in nodal) else None

    def use_load(self, load: Float64) -> None:
        """Has forces added to `load` (nodes, 3), the array `force` of another effect, for the energy balance."""
        self.load, self._own_load = load, False

    def force_launches(self, system: System, stencil: Stencil | None, frames: bool) -> list[Launch]:
        return []  # those of `stage_launches`

    def balance_arrays(self) -> dict[str, Float64]:
        if not self._own_load:
            return {}
        w = self.world
        spring, anchor = np.zeros(w.nodes), np.zeros((w.nodes, 3))
        w.backend.keep(spring, anchor)
        return {"force": self.load, "spring": spring, "anchor": anchor}

    def first_launches(
        self, system: System, beta: Float64, inertial_increment: Float64, euler: bool = False
    ) -> list[Launch]:  # fmt: skip
        """Returns the launches before all others of a step; none where no holder moves.

        beta, inertial_increment: of the integrator. euler: of a step of backward Euler in a scene of another scheme,
        whose first launches have been those of the scheme
        """
        w = self.world
        if not any(h.keyframes or h.moved for h in w.holders):
            return []
        # An explicit scheme moves held nodes by the predictor, and has one velocity for all forces.
        dx_dv, unused = (w.dt, np.zeros_like(w.v)) if w.explicit else (w.dx_dv, w.damping_velocity)
        whole, search = 1 / w.balance_point, w.searches and not euler  # of the step, over what is solved for
        w.backend.keep(unused)
        if whole != 1:
            beta = w.beta_of_nodes(whole)
            w.backend.keep(beta)
        text = w.backend.module(TEXT)
        hold: Launch = text.bind(
            "hold", len(self.node), node=self.node, holder=self.holder, witness=self._witnesses(), free=w.free,
            start=self.start, arm=self.arm, center=self.center, begin=self.begin, end=self.end, velocity=self.velocity,
            beta=beta, h=w.dt, dx_dv=whole * dx_dv, force_coefficient=w.force_coefficient, plain=int(w.plain),
            search=int(search), euler=int(euler), next=self.next, later=self.later, x=w.x, v=w.v,
            predictor=w.predictor, damping_velocity=unused, inertial_increment=inertial_increment,
        )  # fmt: skip
        launches = [hold] if euler else [self.place(system), hold]
        if search and whole != 1:
            launches.append(self._hold_within(text))
        return launches

    def _hold_within(self, text: Module) -> Launch:
        """Returns the launch that has held nodes where the forces of the generalized-alpha method balance."""
        w = self.world
        launch: Launch = text.bind(
            "hold_within", len(self.node), node=self.node, holder=self.holder, witness=self._witnesses(), free=w.free,
            start=self.start, arm=self.arm, center=self.center, begin=self.begin, next=self.next,
            share=w.balance_point, x=w.x,
        )  # fmt: skip
        return launch

    def last_launches(self, system: System, euler: bool = False) -> list[Launch]:
        """Returns the launches after the solve, before the state advances. euler: as of `first_launches`."""
        w = self.world
        mass = w.mass if w.inertia else np.zeros(w.nodes)
        first, last = system.held_couplings(self.node)
        if w.explicit:  # b holds the whole force
            last = first
        w.backend.keep(mass, first, last)
        text = w.backend.module(TEXT)
        settle = text.bind(
            "settle", len(self.node), node=self.node, holder=self.holder, witness=self._witnesses(), free=w.free,
            start=self.start, arm=self.arm, center=self.center, begin=self.begin, next=self.next, later=self.later,
            first=first, last=last, columns=system.held_columns, blocks=system.sums, rotation=system.rotation,
            y=system.y, b=system.b, mass=mass, dx_dv=w.dx_dv / w.balance_point,
            force_coefficient=w.force_coefficient, plain=int(w.plain), search=int(w.searches and not euler),
            inertia=int(w.inertia), clock=system.clock, settled=self._settled, x=w.x,
            predictor=w.predictor, velocity=self.velocity, force=self.force, load=self.load,
        )  # fmt: skip
        return [settle, self._total()]

    def stage_launches(self, system: System, stages: "Stages") -> tuple[list[Launch], list[Launch], list[Launch]]:
        """Returns the launches of a step by stages: before the forces of the first, of the second, and at the end.

        Without a holder that moves there are none of the first.
        """
        w, text = self.world, self.world.backend.module(TEXT)
        n, both = len(self.node), {"node": self.node, "witness": self._witnesses(), "free": w.free}
        state: dict[str, Any] = {"x": w.x, "v": w.v, "next": self.next, "later": self.later}
        state |= {"damping_velocity": w.damping_velocity, "inertial_increment": stages.inertial_increment}
        state |= both | {"share": stages.share}
        first = text.bind(
            "hold_first", n, holder=self.holder, body=system.body, start=self.start, arm=self.arm, center=self.center,
            begin=self.begin, end=self.end, beta=stages.beta, h=w.dt, velocity=self.velocity, shift=self._shift,
            moves=self.moves, **state,
        )  # fmt: skip
        second = text.bind("hold_second", n, shift=self._shift, b=system.b, sum=self._sum, **state)
        settle = text.bind(
            "settle_stages", n, body=system.body, moving=system.moving, mass=w.mass, weight=stages.weight, h=w.dt,
            force_coefficient=w.force_coefficient, clock=system.clock, settled=self._settled, velocity=self.velocity,
            sum=self._sum, b=system.b, predictor=w.predictor, dv=system.dv, estimate=stages.estimate,
            force=self.force, load=self.load, **state,
        )  # fmt: skip
        moved = any(h.keyframes or h.moved for h in w.holders)
        return [self.place(system), first] if moved else [], [second], [settle, self._total()]

    def _total(self) -> Launch:
        """Returns the launch that adds up the forces on each holder."""
        total: Launch = self.world.backend.module(TEXT).bind(
            "total", len(self.first), first=self.first, last=self.last, place=self._place, end=self.end,
            next=self.next, force=self.force, reaction=self.world.reaction,
        )  # fmt: skip
        return total

    def _witnesses(self) -> Int32:
        """Returns for each held node one of its body that nothing holds, (n,): it is fixed where the body is frozen."""
        found = [b.first + int(np.flatnonzero(self.world.free[b.nodes])[0]) for b in self._bodies]
        witness: Int32 = np.array(found, np.int32)[self.holder]
        self.world.backend.keep(witness)
        return witness


def _frames(holder: Holder, center: Float64) -> list[tuple[float, list[float]]]:
    """Returns times [s] and poses (7,) of a holder: where it begins, and its keyframes, which are relative to that."""
    x, y, z = center.tolist()
    rest = (0.0, [x, y, z, 1.0, 0.0, 0.0, 0.0])
    moved = [(k.time, pose_of(k)) for k in holder.keyframes or ()]
    keys = [(time, [x + p[0], y + p[1], z + p[2], *p[3:]]) for time, p in moved]
    return keys if keys and keys[0][0] == 0 else [rest, *keys]


def _mask(world: World, holder: Holder) -> NDArray[np.bool_]:
    """Returns which nodes of the scene a holder holds; raises InputError for none, all, or nodes held already."""
    body, held = world.body(holder.object), np.zeros(world.nodes, bool)
    held[body.nodes] = where.nodes(holder.where, body.mesh)
    count = int(held.sum())
    if not 0 < count < body.last - body.first:
        raise InputError(
            f"holder {holder.name!r}: where = {holder.where!r} holds {count} of {body.last - body.first} nodes of "
            f"object {body.name!r}; it must hold some and leave some free"
        )
    fixed = body.effects.get("fixed")
    others = world.held > 0
    if fixed is not None:
        from sim_server.effects.fixed import clamped_nodes  # what a scene does not list is not imported

        others[body.nodes] |= clamped_nodes(fixed, body.mesh)
    if (held & others).any():
        raise InputError(
            f"holder {holder.name!r}: {int((held & others).sum())} of its nodes are fixed, or another holder's: a node "
            "is held once"
        )
    if not (world.free[body.nodes] > 0)[~(held | others)[body.nodes]].any():
        raise InputError(f"holder {holder.name!r}: no node of object {body.name!r} is left free")
    return held
