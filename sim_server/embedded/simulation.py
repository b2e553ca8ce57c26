# SPDX-License-Identifier: MIT
"""Simulations within a program of one's own, without a network."""

import logging
import weakref
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sim_server import simulation as simulations
from sim_server.arrays import Float64
from sim_server.effects._base import Effect
from sim_server.embedded.external_forces import ExternalForces
from sim_server.embedded.factor_threads import FactorThreads, NoFactors
from sim_server.embedded.scene import Scene, plain
from sim_server.errors import InputError
from sim_server.mechanics.named_points import NamedPoints
from sim_server.parameters import toml
from sim_server.state.start import Start
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import FactorSource
from sim_server.updates.first_factors import FirstFactors
from sim_server.updates.patterns import Patterns

log = logging.getLogger(__name__)

OURS = "python"  # the client that pushes of this process are of
IN_STEPS = ("never", "every")  # policies whose steps make their own factors


class Simulation:
    """A scene that is stepped here. scene: a Scene, a path, gallery/NAME, or a table; device: "cpu" or "gpu".

    forces: makes room for external `forces`. workers: threads that make factors while steps run; 0: nothing makes any
    for `update = "async"` and `"adaptive"`, and steps with `"lockstep-D"` make their own.

    Runs are not recorded. Use it as a context manager, or close it. Raises InputError for a scene that cannot be built.

    >>> with Simulation("gallery/beam") as simulation:
    ...     records = simulation.step(50)
    ...     print(simulation.time, simulation.positions("beam").min(axis=0), records["iterations"].mean())
    """

    def __init__(
        self, scene: Scene | Mapping[str, Any] | str | Path, device: str = "cpu", forces: bool = False,
        workers: int = 1,
    ):  # fmt: skip
        if workers < 0:
            raise InputError(f"workers = {workers}: must be 0 or more")
        if not isinstance(scene, Scene):
            scene = Scene.load(scene) if isinstance(scene, str | Path) else Scene(scene)
        built = (_WithForces if forces else simulations.Simulation)(scene.checked, device)
        _tell_of_cuts(built)
        self.scene = scene
        self.records: NDArray[Any] = np.zeros(0, built.engine.records_dtype)  # of the last call of `step`
        self._external = built.effects.get(ExternalForces.name)
        self._start, self._begun = Start(built), built.world.x.copy()
        source = _source(built, workers)
        self._driver: Driver | None = Driver(built, source)
        waits = isinstance(source, FactorThreads) and self._driver.policy.free and self._driver.wants_factors
        self._first = FirstFactors(self._driver) if waits and built.scene.solver.first_factor != "go" else None
        self._end_threads = weakref.finalize(self, source.close if isinstance(source, FactorThreads) else list)

    def step(self, steps: int = 1) -> NDArray[Any]:
        """Makes steps and returns their records, one of each body and step: iterations, status, residual, seconds.

        The first step waits for its own factors unless the scene says `first_factor = "go"`. Raises InputError for a
        number of steps below 1.
        """
        if steps < 1:
            raise InputError(f"step({steps}): must be at least 1")
        driver, made = self._open, []
        driver.simulation.world.backend.settle()
        if self._first is not None:
            self._first.run()
            self._first = None
            made.append(driver.pump())
        if left := steps - len(made):
            made.append(driver.advance(left))
        self.records = np.concatenate(made)
        return self.records

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        engine = self._open.engine
        return float(engine.loop.start_time + engine.step * self._open.simulation.world.dt)

    @property
    def objects(self) -> list[str]:
        """Names of the objects, in the order of their nodes."""
        return [body.name for body in self._open.simulation.world.bodies]

    @property
    def x(self) -> Any:
        """Positions of all nodes (n, 3) [m], objects one after another: the memory that steps write, not a copy.

        An array of NumPy, on a GPU of CuPy; both have DLPack, so that torch.from_dlpack(simulation.x) needs no copy.
        """
        world = self._open.simulation.world
        return world.backend.view(world.x)

    @property
    def v(self) -> Any:
        """Velocities (n, 3) [m/s], as x."""
        world = self._open.simulation.world
        return world.backend.view(world.v)

    @property
    def forces(self) -> Any:
        """External forces (n, 3) [N], as x: those in it act on the nodes in each step until others are written.

        Also set as a whole, simulation.forces = array of (n, 3) or (3,). A reset leaves them. Raises InputError for a
        simulation without room for them, and arrays that do not fit.
        """
        return self._open.simulation.world.backend.view(self._room.force)

    @forces.setter
    def forces(self, values: ArrayLike) -> None:
        backend, force = self._open.simulation.world.backend, self._room.force
        given = values.get() if hasattr(values, "get") else np.asarray(values)  # of CuPy
        if given.shape not in ((3,), force.shape) or given.dtype.kind not in "fiu" or not np.isfinite(given).all():
            raise InputError(
                f"forces of shape {given.shape} and type {given.dtype}: must be finite numbers {force.shape} or (3,)"
            )
        force[...] = given
        backend.push(force)

    def positions(self, name: str) -> Any:
        """Returns the rows of x of an object. Raises InputError for an unknown one."""
        return self.x[self._nodes(name)]

    def velocities(self, name: str) -> Any:
        """Returns the rows of v of an object. Raises InputError for an unknown one."""
        return self.v[self._nodes(name)]

    def displacements(self, name: str) -> Float64:
        """Returns how far the nodes of an object are from where they began (n, 3) [m], a copy on the host."""
        nodes = self._nodes(name)
        moved: Float64 = self._open.simulation.fetch().x[nodes] - self._begun[nodes]
        return moved

    def tip(self, name: str) -> int:
        """Returns the row of an object's tip: its free node that is farthest at rest from the fixed ones, or without
        these from its middle. Raises InputError."""
        self._nodes(name)
        world = self._open.simulation.world
        return NamedPoints(world, world.body(name)).tip_node

    def push(
        self, name: str, at: Sequence[float] | str, force: Sequence[float], duration: float, radius: float = 0.0
    ) -> None:
        """Adds a force [N] on the free nodes within `radius` [m] of a point, for `duration` [s] from the next step.

        at: coordinates [m] or a named point (tip, top, ...); radius 0: the nearest node. Raises InputError.
        """
        self._nodes(name)
        touch = self._open.simulation.touch
        if touch is None:
            raise InputError(f"push: the scene lists no touch; object {name!r} may have touch = true in its effects")
        try:
            point = touch.points(name).named(at) if isinstance(at, str) else _triple(at)
            touch.push(OURS, name, point, radius, _triple(force), duration)
        except ValueError as error:
            raise InputError(f"push: {error}") from None

    def set(self, key: str | Mapping[str, Any], value: Any = None) -> None:
        """Changes a live parameter before the next step, e.g. "beam.corotational.young", or several at once, a mapping
        of values by key, all or none of them. Values may be those of NumPy; a text is a value as on the command line.
        Raises InputError."""
        values = key if isinstance(key, Mapping) else {key: value}
        given = {k: each if isinstance(each, str) else toml(plain(each)) for k, each in values.items()}
        try:
            self._open.simulation.parameters.set(given)
        except ValueError as error:
            raise InputError(str(error)) from None

    def reset(self, *names: str) -> None:
        """Puts objects, or with no name all, back to where they began; time goes on. Their pushes end, bodies that were
        frozen move again; forces and parameters that were set stay. Raises InputError."""
        names = tuple(name for name in names if name)
        for name in names:
            self._nodes(name)
        driver = self._open
        driver.simulation.world.backend.settle()
        if (touch := driver.simulation.touch) is not None:
            with touch.together():
                for name in names or ("",):
                    touch.release_of(name)
        self._start.reset(*names)
        for state in driver.bodies:
            if not names or state.body.name in names:
                state.frozen = False

    @property
    def lost(self) -> list[str]:
        """Objects that have run away and move no more until they are reset."""
        return [state.body.name for state in self._open.bodies if state.frozen]

    @property
    def inside(self) -> simulations.Simulation:
        """The simulation that is stepped, with all that sim_server has of it."""
        return self._open.simulation

    def close(self) -> None:
        """Lets go of memory and device; arrays that were taken stay as they are. More than once is allowed."""
        if self._driver is not None:
            self._end_threads()
            self._driver = self._first = self._external = None
            del self._start

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self.close()

    @property
    def _open(self) -> Driver:
        if self._driver is None:
            raise InputError("this simulation is closed")
        return self._driver

    @property
    def _room(self) -> ExternalForces:
        if not isinstance(self._external, ExternalForces):
            raise InputError("forces: there is no room for them; make the simulation with forces=True")
        return self._external

    def _nodes(self, name: str) -> slice:
        if name not in self.objects:
            raise InputError(f"no object {name!r}; there is {', '.join(self.objects)}")
        return self._open.simulation.world.body(name).nodes


class _WithForces(simulations.Simulation):
    """A simulation with external forces on all nodes."""

    def make_effects(self) -> dict[str, Effect]:
        effects = super().make_effects()
        effects[ExternalForces.name] = ExternalForces(self.world)
        return effects


def _tell_of_cuts(simulation: simulations.Simulation) -> None:
    """Says what in the scene cuts only beside the steps of a server."""
    edges = [f"obstacle {o.name!r} has an edge" for o in simulation.scene.obstacles or () if o.edge is not None]
    listed = [(b.name, b.effects.get("cutting")) for b in simulation.world.bodies]
    tears = [f"object {name!r} has cutting.tear" for name, cutting in listed if cutting and cutting.tear is not None]
    if found := [*edges, *tears]:
        log.warning(
            '%s: that cuts in a server alone; here set("NAME.cutting.removed", "3 7-9") removes elements',
            " and ".join(found),
        )


def _source(simulation: simulations.Simulation, workers: int) -> FactorSource | None:
    """Returns what makes factors beside the steps; None: nothing does, as the policy has it."""
    solver = simulation.scene.solver
    if not solver.wants_factors or solver.update.kind in IN_STEPS or (not workers and solver.update.kind == "lockstep"):
        return None
    if workers:
        return FactorThreads(Patterns.of(simulation), workers)
    log.warning(
        'nothing makes factors: solver.update = "%s" and workers = 0; steps are as exact and take more iterations. '
        'Write workers = 1, or update = "every-30", whose steps make them',
        solver.update,
    )
    return NoFactors()


def _triple(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z
