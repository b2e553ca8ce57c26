# SPDX-License-Identifier: MIT
"""A source of factors in this process that is sent positions, as a worker that builds the matrix itself."""

from dataclasses import replace

from sim_server.recording import messages
from sim_server.simulation import Simulation
from sim_server.updates.factor_source import Inline, Job
from sim_server.updates.worker_assembly import Assembly


class BuildingInline(Inline):
    """Factorizes during submit, the matrix assembled from positions where the job holds those."""

    def __init__(self, simulation: Simulation):
        bodies = simulation.world.bodies
        super().__init__({b.name: simulation.system.body_pattern(b.first, b.last) for b in bodies})
        scene = messages.scene(simulation)
        self._assemblies = {b.name: Assembly(scene, messages.topology(simulation, b)) for b in bodies}

    def assembles_matrices(self) -> bool:
        return True

    def submit(self, job: Job) -> bool:
        if job.positions:
            job = replace(job, values=self._assemblies[job.object].matrix(job.values))
        return super().submit(job)
