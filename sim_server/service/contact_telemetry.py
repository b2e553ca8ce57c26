# SPDX-License-Identifier: MIT
"""What contact and holders add to telemetry: obstacles, poses, and lines about what was left undone."""

import time
from collections import Counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64
from sim_server.network.link import ServerLink
from sim_server.recording.obstacles import obstacle_messages, pose_messages
from sim_server.recording.recorder import Recorder
from sim_server.simulation import Simulation

ROWS_PERIOD = 1.0  # s between checks for nodes without enough rows


class ContactTelemetry:
    """The obstacles and holders of one run; of a scene without any nothing is sent and nothing is said.

    clipped: by body, number of nodes that were held back at obstacles, summed over steps
    crowded: likewise, of obstacles that had no row at a node as nearer ones had them
    """

    def __init__(self, simulation: Simulation, link: ServerLink, recorder: Recorder | None):
        self._simulation, self._link, self._recorder = simulation, link, recorder
        self._rows_due = 0.0
        self._crowded: set[int] = set()  # bodies of which it was said
        self.clipped: Counter[int] = Counter()
        self.crowded: Counter[int] = Counter()
        self._broken: set[int] = set()  # attachments and springs of which it was said

    def open(self) -> None:
        """Sends the obstacles to log and network."""
        for obstacle in obstacle_messages(self._simulation):
            self._link.set_obstacle(obstacle)
            if self._recorder:
                self._recorder.obstacle(obstacle)

    def on_reset(self) -> None:
        """Takes note that something was put back: what breaks again is told again."""
        self._broken.clear()

    def look(self) -> bool:
        """Returns True if somebody wants poses."""
        return any(mover.listed for mover in self._simulation.movers) and self._link.wants_pose()

    def publish_poses(self, step: int, poses: Float64) -> None:
        """Sends the poses (obstacles, 7) after a step to subscribers."""
        for pose in pose_messages(self._simulation, step, poses):
            self._link.publish_pose(pose)

    def record_poses(self, step: int, poses: Float64 | None, block: bool) -> None:
        """Sends the poses (obstacles, 7) after a step to the log. None: those before the first step, as they are."""
        assert self._recorder is not None
        for pose in pose_messages(self._simulation, step, poses):
            self._recorder.pose(pose, block)

    def count_clipped(self, records: NDArray[Any]) -> list[str]:
        """Counts nodes that were held back at obstacles after the passes; returns a line for each new object."""
        lines = []
        for r in records[records["clipped"] > 0]:
            body = self._simulation.world.bodies[int(r["body"])]
            if body.index not in self.clipped:
                lines.append(
                    f"object {body.name!r}, step {int(r['step'])}: {int(r['clipped'])} nodes would have passed into an "
                    "obstacle or another object and were held back; at an obstacle momentum is then not exact; further "
                    "ones are counted. A smaller dt or "
                    "more passes (effects.contact) may help"
                )
            self.clipped[body.index] += int(r["clipped"])
        return lines

    def broken_ties(self) -> list[str]:
        """Returns a line for each attachment or spring of which something broke, at the first time."""
        ties, world = self._simulation.ties, self._simulation.world
        if ties is None:
            return []
        names, lines = self._simulation.reaction_names[-ties.tables :], []
        for table in set(ties.table[ties.broken > 0].tolist()) - self._broken:
            self._broken.add(table)
            step, rows = (
                int(ties.broken[(ties.table == table) & (ties.broken > 0)].min()),
                int((ties.table == table).sum()),
            )
            lines.append(
                f"{names[table]!r} breaks, at step {step} ({step * world.dt:.4g} s)"
                + (f", the first of its {rows} nodes; forces on it tell of the others" if rows > 1 else "")
            )
        return lines

    def crowded_nodes(self) -> list[str]:
        """Returns a line for each new object with nodes that had more obstacles near than they have rows for."""
        contact = self._simulation.contact
        if contact is None or time.monotonic() < self._rows_due:
            return []
        self._rows_due = time.monotonic() + ROWS_PERIOD
        dropped = self._simulation.world.backend.fetch(contact.dropped)
        sums = np.bincount(contact.body, dropped, len(self._simulation.world.bodies)).astype(int)
        self.crowded = Counter({body: count for body, count in enumerate(sums.tolist()) if count})
        found = set(self.crowded) - self._crowded
        self._crowded |= found
        return [
            f"object {self._simulation.world.bodies[body].name!r}: some places had more obstacles or objects near than "
            "rows at a time; they touch the nearest only; further ones are counted"
            for body in sorted(found)
        ]
