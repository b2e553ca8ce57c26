# SPDX-License-Identifier: MIT
"""Lines that tell of steps that went wrong, each of its kind and object once; and counts of them."""

from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.backends.kinds import SLACK_OF_ENERGY
from sim_server.mechanics.world import Body, World
from sim_server.simulation import Simulation

MANY_SUBSTEPS = 10_000  # explicit ones of a step, of which it is told


class StepWarnings:
    """Looks records of steps through for what went wrong.

    solves: records that were looked through
    unconverged: solves by status, of those that did not converge
    runaways: steps by body that has run away
    """

    def __init__(self, simulation: Simulation):
        self.simulation = simulation
        self.solves = 0
        self.unconverged: Counter[str] = Counter()
        self.runaways: Counter[int] = Counter()
        self._not_finite: set[str] = set()  # objects of which it was said
        self._halved: set[int] = set()  # bodies of which it was said
        self._gained: set[int] = set()  # likewise, that they have gained energy
        self._told_substeps = False

    def warnings(self, records: NDArray[Any]) -> list[str]:
        """Returns lines of what is wrong, while the run goes on as asked."""
        told = [*self.count_unconverged(records), *self.halved(records)]
        return [*told, *self.gained_energy(records), *self.many_substeps()]

    def errors(self, records: NDArray[Any]) -> list[str]:
        """Returns lines of objects that do not go on as asked."""
        return [*self.count_runaways(records), *self.not_finite(records)]

    def on_reset(self, body: Body) -> None:
        """Forgets what was said of a body that is put back to the start."""
        self.runaways.pop(body.index, None)
        self._halved.discard(body.index)
        self._gained.discard(body.index)
        self._not_finite.discard(body.name)

    def count_unconverged(self, records: NDArray[Any]) -> list[str]:
        """Counts solves that did not converge, by status; returns a line for the first."""
        self.solves += len(records)
        failed = records[(records["status"] != pb.CONVERGED) & (records["status"] != pb.RUNAWAY)]
        if not len(failed):
            return []
        first = not self.unconverged
        self.unconverged.update(pb.SolveStatus.Name(int(s)).lower() for s in failed["status"])
        if not first:
            return []
        r, status = failed[0], next(iter(self.unconverged))
        name = self.simulation.world.bodies[int(r["body"])].name
        column = "contact_residual" if r["status"] == pb.CONTACT else "residual"
        return [
            f"object {name!r}, step {int(r['step'])}: not converged ({status}, residual {float(r[column]):.1e}); "
            "further ones are counted"
        ]

    def not_finite(self, records: NDArray[Any]) -> list[str]:
        """Returns a line for each object whose solve met numbers that are not finite for the first time."""
        return not_finite_lines(self.simulation, records, self._not_finite)

    def count_runaways(self, records: NDArray[Any]) -> list[str]:
        """Counts steps of bodies that have run away; returns a line for each new one, with the cause."""
        away, lines = records[records["status"] == pb.RUNAWAY], []
        for r in away[np.unique(away["body"], return_index=True)[1]]:
            body = self.simulation.world.bodies[int(r["body"])]
            if body.index not in self.runaways:
                frozen = self.simulation.energies.freezes
                then = "it is frozen where the step began" if frozen else "it goes on"
                lines.append(
                    f"object {body.name!r}, step {int(r['step'])}: runaway: {cause_of(r)}; {then} "
                    f"(solver.on_runaway = {self.simulation.scene.solver.on_runaway!r}). A smaller dt, more "
                    "linearizations or the scheme backward_euler may help"
                )
        self.runaways.update(away["body"].tolist())
        return lines

    def gained_energy(self, records: NDArray[Any]) -> list[str]:
        """Returns a line for each object that has far more energy than it was given, kinetic and elastic together, for
        the first time. Steps whose elastic energy is known; what moves little is not found by its kinetic energy."""
        lines, world = [], self.simulation.world
        if world.explicit or (world.loading and world.backend.name == "gpu"):
            return []
        energy = records["kinetic"] + records["elastic"]
        for r in records[energy > SLACK_OF_ENERGY * np.maximum(records["budget"], 0.0)]:
            body = world.bodies[int(r["body"])]
            floor = least_energy(world, body)
            if world.loading and world.load[body.nodes].any():  # the work of loads is known to a part alone
                continue
            if body.index in self._gained or not r["kinetic"] + r["elastic"] > 2 * r["budget"] + floor:
                continue
            self._gained.add(body.index)
            lines.append(
                f"object {body.name!r}, step {int(r['step'])}: it has {r['kinetic'] + r['elastic']:.3g} J, kinetic and "
                f"elastic, where start and loads account for {r['budget']:.3g} J: an error of the time step. A smaller "
                "dt or more linearizations may help"
            )
        return lines

    def many_substeps(self) -> list[str]:
        """Returns a line, once, if a step makes very many explicit substeps: while the first one is under way."""
        count, dt = self.simulation.engine.substeps, self.simulation.world.dt
        if self._told_substeps or count <= MANY_SUBSTEPS:
            return []
        self._told_substeps = True
        return [
            f"a step of dt = {dt:g} s takes {count:,} explicit substeps of {dt / count:.2g} s, each of which evaluates "
            "all forces: the stiffest or smallest element allows none longer. What helps: softer material, no slivers, "
            'or integrator.scheme = "backward_euler" or "ros2", which have no such limit'
        ]

    def halved(self, records: NDArray[Any]) -> list[str]:
        """Returns a line for each object whose step was made again by short ones for the first time."""
        lines = []
        for r in records[records["halvings"] > 0]:
            body = self.simulation.world.bodies[int(r["body"])]
            if body.index not in self._halved:
                self._halved.add(body.index)
                lines.append(
                    f"object {body.name!r}, step {int(r['step'])}: ran away; made again by {2 ** int(r['halvings'])} "
                    "short steps, as the next ones are; further ones are counted"
                )
        return lines


def not_finite_lines(simulation: Simulation, records: NDArray[Any], known: set[str]) -> list[str]:
    """Returns a line for each object whose solve met numbers that are not finite for the first time.

    known: objects of which that was said before; the names of new ones are added
    """
    lines = []
    for r in records[records["bad_node"] >= 0]:
        name = simulation.world.bodies[int(r["body"])].name
        if name not in known:
            known.add(name)
            begin = float(r["time"]) - simulation.world.dt / 2
            refused = [x for x in simulation.refusals() if x.body == int(r["body"]) and x.time < begin]
            latest = max(refused, key=lambda x: x.time, default=None)  # before, a line search may have tried one
            why = str(latest) if latest else f"force is not finite at node {int(r['bad_node'])}"
            lines.append(
                f"object {name!r}, step {int(r['step'])}: {why}; "
                "it goes back to where the step before began and rests there"
            )
    return lines


def least_energy(world: World, body: Body) -> float:
    """Energy of a body all of whose nodes move by a thousandth of its size in a step, below which a balance may be
    rounding [J]; the floor of kernels/energy_balance.cuh."""
    size = float(np.linalg.norm(np.ptp(world.rest[body.nodes], axis=0)))
    return 0.5 * float(world.mass[body.nodes].sum()) * (1e-3 * size / world.dt) ** 2


def cause_of(r: np.void) -> str:
    """Says what a record (structs.RECORD) shows of a body that ran away."""
    if not (np.isfinite(r["kinetic"]) and np.isfinite(r["gravity"])):
        return "its positions or velocities are no finite numbers"
    if r["kinetic"] > SLACK_OF_ENERGY * max(r["budget"], 0.0):
        return f"kinetic energy {r['kinetic']:.3g} J, where start and loads account for {r['budget']:.3g} J"
    return f"two of its nodes moved {r['stride']:.3g} m apart within a step"
