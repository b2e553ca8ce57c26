# SPDX-License-Identifier: MIT
"""What a server says to the terminal at its start and at its end."""

from collections.abc import Callable
from pathlib import Path

from protocol.channels import DEFAULT_ENDPOINT, SERVER_NAME
from protocol.network.endpoints import on_this_machine
from sim_server.service.scene_notes import scene_notes
from sim_server.service.service import Service

Say = Callable[[str], None]


def announce(say: Say, service: Service, scene: Path, listen: list[str]) -> None:
    """Says what is simulated, where, and where it listens."""
    world, solver = service.simulation.world, service.simulation.scene.solver
    tets = sum(len(b.mesh.tets) for b in world.bodies)
    say(
        f"{scene.name}: {len(world.bodies)} object{'s' * (len(world.bodies) > 1)}, {world.nodes} nodes, {tets} tets, "
        f"dt {world.dt:g} s, preconditioner {solver.preconditioner}, update {solver.update}; {world.backend.name}; "
        f"listening on {', '.join(listen)}"
    )


def describe_objects(say: Say, service: Service, listen: list[str] | None, tls: str | None) -> None:
    """Reports size and mass of each object, where a mesh in millimetres or a density in g/cm3 shows, and notes."""
    world = service.simulation.world
    for body in world.bodies[:20]:
        size = " x ".join(f"{s:.3g}" for s in body.mesh.rest.max(axis=0) - body.mesh.rest.min(axis=0))
        say(f"  {body.name}: {body.last - body.first} nodes, {size} m, {world.mass[body.nodes].sum():.3g} kg")
    for line in scene_notes(service.simulation):
        say(f"note: {line}")
    if service.driver.wants_factors and service.driver.policy.free and not service.link.dispatch.workers():
        say(
            "no worker is there, so nothing makes factors and solves use block Jacobi; start one in a second terminal, "
            f"{_worker_command(service.link.name, listen, tls)}, or this server with --workers 1"
        )


def _worker_command(name: str, listen: list[str] | None, tls: str | None) -> str:
    """Returns the command that starts a worker for this server on this machine."""
    words = ["precond-worker"]
    if listen and listen[0] != DEFAULT_ENDPOINT:
        words += ["--connect", on_this_machine(listen[0])]
    if name != SERVER_NAME:
        words += ["--server", name]
    if tls is not None:
        words += ["--tls", tls]
    return " ".join(words)


def summary(service: Service) -> str:
    """Returns times of steps, use of factors and what went wrong, for the end of a run."""
    p50, p99, most = (1e3 * s for s in service.telemetry.summary.percentiles())
    used = sum(state.factors.used for state in service.driver.bodies)
    return (
        f"{service.engine.step} steps; last {len(service.telemetry.summary.seconds)}: p50 {p50:.3f}, p99 {p99:.3f}, "
        f"max {most:.3f} ms; {used} factors used, {service.engine.loop.late_steps} late steps; "
        f"{_unconverged(service)}{_runaways(service)}"
    )


def _unconverged(service: Service) -> str:
    """Returns how many solves did not reach the tolerance, by cause."""
    counts = service.telemetry.warnings.unconverged
    if not counts:
        return "all solves converged"
    why = ", ".join(f"{n} {status}" for status, n in counts.most_common())
    return f"{sum(counts.values())} of {service.telemetry.warnings.solves} solves not converged ({why})"


def _runaways(service: Service) -> str:
    """Returns the names of objects that have run away; empty if none have."""
    names = [service.simulation.world.bodies[body].name for body in sorted(service.telemetry.warnings.runaways)]
    return f"; run away: {', '.join(names[:20])}" if names else ""
