# SPDX-License-Identifier: MIT
"""Removes elements that are stretched too far, as a client would: beside the steps, by the parameter of the effect."""

import time

import numpy as np

from sim_server.arrays import Float64, Int64
from sim_server.mechanics.cut_shapes import torn
from sim_server.mechanics.removal import present, removal
from sim_server.mesh.shape_functions import shape_gradients
from sim_server.simulation import Simulation

PERIOD = 0.02  # s between two looks


class Tearing:
    """Looks at the objects whose scene gives a limit of stretch."""

    def __init__(self, simulation: Simulation):
        self._simulation = simulation
        self._bodies = [
            b for b in simulation.world.bodies if "cutting" in b.effects and b.effects["cutting"].tear is not None
        ]
        self._gradients: dict[int, Float64] = {}
        self._seen: dict[int, Int64] = {}  # what was too long at the last look, by body
        self._due, self._step = 0.0, -1

    def look(self) -> None:
        """Removes what was too long at two looks in a row, if there is something to look at and it is due."""
        step = self._simulation.engine.step
        if not self._bodies or step == self._step or time.monotonic() < self._due:
            return
        self._step, begin = step, time.monotonic()
        world, scene = self._simulation.world, self._simulation.parameters.scene
        x = world.backend.fetch(world.x).copy()  # on a CPU the loop may be writing it: so one look is not enough
        values: dict[str, str] = {}
        for body in self._bodies:
            if body.index not in self._gradients:
                self._gradients[body.index] = shape_gradients(body.mesh.rest, body.mesh.tets)[1]
            limit = scene.objects[body.index].effects["cutting"].tear  # type: ignore[attr-defined]
            there = present(scene, [body]) > 0
            tets = body.mesh.tets if world.splitting is None else world.splitting.tets(scene, body) - body.first
            seen = torn(x[body.nodes], tets, self._gradients[body.index], there, limit)
            found, self._seen[body.index] = np.intersect1d(seen, self._seen.get(body.index, seen[:0])), seen
            if len(found):
                values |= removal(scene, body, found)
        if values:
            self._simulation.parameters.set(values)
        end = time.monotonic()
        self._due = end + max(PERIOD, end - begin)  # half of the time is for all else
