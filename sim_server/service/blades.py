# SPDX-License-Identifier: MIT
"""Obstacles with a cutting edge: removes the elements that the edge sweeps, beside the steps."""

import logging
import time

import numpy as np

from protocol import messages_pb2 as pb
from sim_server.arrays import Float64
from sim_server.parameters import BadParameter
from sim_server.scene.pose import turned
from sim_server.service import cuts
from sim_server.simulation import Simulation

log = logging.getLogger(__name__)

PERIOD = 0.02  # s between two looks
FINE = 0.5  # mean edges of the elements that an edge moves before it cuts on, unless it has come to rest


class Blades:
    """Looks at the obstacles of a scene that have an edge, and removes what that has swept since the last cut.

    An edge sweeps the quadrangle between where it was and where it is; its way in between counts as straight.
    """

    def __init__(self, simulation: Simulation):
        self._simulation = simulation
        listed = simulation.scene.obstacles or []
        self._edges = {k: np.array(o.edge) for k, o in enumerate(listed) if o.edge is not None}
        self._names = [o.name for o in listed]
        self._bodies = [b for b in simulation.world.bodies if "cutting" in b.effects] if self._edges else []
        lengths = [_mean_edge(b.mesh.rest[b.mesh.tets]) for b in self._bodies]
        self._fine = FINE * min(lengths, default=0.0)
        self._cut: dict[int, Float64] = {}  # where an edge was when it cut last, (2, 3) [m]
        self._seen: dict[int, Float64] = {}  # where it was at the last look
        self.due, self._step = 0.0, -1

    def restart(self) -> None:
        """Begins anew where obstacles are, which a reset has put there."""
        self._cut.clear()
        self._seen.clear()
        self._step = -1

    def look(self) -> None:
        """Cuts what has been swept, if there is something to look at and it is due."""
        step = self._simulation.engine.step
        if not self._bodies or step == self._step or time.monotonic() < self.due:
            return
        begin = time.monotonic()
        poses = self._poses()
        if poses is None:
            return
        self._step = step
        for k, corners in self._edges.items():
            now = turned(corners, poses[k, 3:]) + poses[k, :3]
            before, last = self._cut.setdefault(k, now), self._seen.get(k, now)
            self._seen[k] = now
            moved = float(np.linalg.norm(now - before, axis=1).max())
            if moved > self._fine or (moved > 0 and np.array_equal(now, last)):
                self._cut[k] = now
                self._sweep(self._names[k], before, now)
        end = time.monotonic()
        self.due = end + max(PERIOD, end - begin)  # half of the time is for all else

    def _poses(self) -> Float64 | None:
        """Returns the poses of all obstacles (m, 7); None while the loop is writing them."""
        contact = self._simulation.contact
        assert contact is not None
        once, again = (contact.world.backend.fetch(contact.end).copy() for _ in range(2))
        return again if np.array_equal(once, again) else None

    def _sweep(self, name: str, before: Float64, now: Float64) -> None:
        corners = [pb.Vector(x=x, y=y, z=z) for x, y, z in (before[0], before[1], now[1], now[0])]
        for body in self._bodies:
            try:
                cuts.carry_out(self._simulation, pb.Cut(object=body.name, blade=corners), name)
            except (cuts.BadCut, BadParameter) as error:
                log.warning("obstacle %r cuts nothing of object %r: %s", name, body.name, error)


def _mean_edge(corners: Float64) -> float:
    """Returns the mean length of the edges of tetrahedra (m, 4, 3) [m]."""
    pairs = [(a, b) for a in range(4) for b in range(a)]
    return float(np.mean([np.linalg.norm(corners[:, a] - corners[:, b], axis=1).mean() for a, b in pairs]))
