# SPDX-License-Identifier: MIT
"""Simulations within a program of one's own, without a network: what `import warpfactor` offers of the server.

Steps wait for the factors of their matrices, which this process makes, as often as the scene's `update` says.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import scipy  # noqa: F401  where it is needed it is imported later: a client alone is told of it here
from numpy.typing import ArrayLike, NDArray

from sim_server import scene as scenes
from sim_server import simulation as simulations
from sim_server.arrays import Float64
from sim_server.errors import InputError
from sim_server.mesh.arrays import mesh_of
from sim_server.state.start import Start
from sim_server.updates.driver import Driver

OURS = "python"  # the client that pushes of this process are of


class Mesh:
    """Nodes and tetrahedra: points (n, 3) [m]; tets, numbers of points, (m, 4), or (e, 10) of quadratic elements.

    groups: elements and nodes by name, for `group` in a scene; numbers of elements, or a table of elements, faces and
    nodes. Tetrahedra are wound to positive volume. Raises InputError for arrays that are no mesh.
    """

    def __init__(
        self, points: ArrayLike, tets: ArrayLike, groups: Mapping[str, Any] | None = None, name: str = "arrays"
    ):
        self.checked = mesh_of(points, tets, groups, name)

    @property
    def points(self) -> Float64:
        """Nodes at rest (n, 3) [m]."""
        return self.checked.rest

    @property
    def tets(self) -> NDArray[np.int32]:
        """Tetrahedra (m, 4)."""
        return self.checked.tets


class Scene:
    """A scene as a table of Python: the keys of a scene file; `mesh` of an object may be a Mesh.

    folder: where files that it names are. Raises InputError with one line for each error.

    >>> Scene({"dt": 0.02, "object": [{"name": "bar", "mesh": {"bar": [2, 2, 8], "size": [0.1, 0.1, 0.4]},
    ...        "effects": {"corotational": {"young": 1e5, "poisson": 0.4}, "fixed": {"where": "Z < 0.01"}}}]})
    """

    def __init__(self, table: Mapping[str, Any], folder: str | Path = "."):
        self.checked = scenes.validated(_with_meshes(table), "from Python", Path(folder))

    @classmethod
    def load(cls, path: str | Path, overrides: Sequence[str] = ()) -> Self:
        """Reads a scene file, or gallery/NAME. overrides: KEY=VALUE, or @FILE, an overlay. Raises InputError."""
        scene = cls.__new__(cls)
        scene.checked = scenes.load(path, overrides)
        return scene

    def table(self) -> dict[str, Any]:
        """The scene with all defaults, as a table."""
        return self.checked.resolved()


class Simulation:
    """A scene that is stepped here. scene: a Scene, a path, gallery/NAME, or a table; device: "cpu" or "gpu".

    Use it as a context manager, or close it. Raises InputError for a scene that cannot be built.

    >>> with Simulation("gallery/beam") as simulation:
    ...     records = simulation.step(50)
    ...     print(simulation.time, simulation.positions("beam").min(axis=0), records["iterations"].mean())
    """

    def __init__(self, scene: Scene | Mapping[str, Any] | str | Path, device: str = "cpu"):
        if not isinstance(scene, Scene):
            scene = Scene.load(scene) if isinstance(scene, str | Path) else Scene(scene)
        built = simulations.Simulation(scene.checked, device)
        self.scene = scene
        self._start = Start(built)
        self._driver: Driver | None = Driver(built)

    def step(self, steps: int = 1) -> NDArray[Any]:
        """Makes steps and returns their records, one of each body and step: iterations, status, residual, seconds.

        Raises InputError for a number of steps below 1.
        """
        if steps < 1:
            raise InputError(f"step({steps}): must be at least 1")
        return self._open.advance(steps)

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
    def x(self) -> Float64:
        """Positions of all nodes (n, 3) [m], objects one after another: the memory that steps write, not a copy.

        On a GPU a copy on the host, as it is at the call.
        """
        return self._open.simulation.fetch().x

    @property
    def v(self) -> Float64:
        """Velocities (n, 3) [m/s], as x."""
        return self._open.simulation.fetch().v

    def positions(self, name: str) -> Float64:
        """The rows of x of an object. Raises InputError for an unknown one."""
        return self.x[self._nodes(name)]

    def velocities(self, name: str) -> Float64:
        """The rows of v of an object. Raises InputError for an unknown one."""
        return self.v[self._nodes(name)]

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

    def set(self, key: str, value: float | bool | str | Sequence[Any]) -> None:
        """Changes a live parameter before the next step, e.g. "beam.corotational.young". Raises InputError."""
        try:
            self._open.simulation.parameters.set({key: value if isinstance(value, str) else json.dumps(value)})
        except ValueError as error:
            raise InputError(str(error)) from None

    def reset(self, name: str = "") -> None:
        """Puts an object, or with no name all, back to where it began; time goes on. Raises InputError."""
        if name or self._driver is None:
            self._nodes(name)
        self._start.reset(name)

    def close(self) -> None:
        """Lets go of memory and device; arrays that were taken stay as they are. More than once is allowed."""
        if self._driver is not None:
            self._driver = None
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

    def _nodes(self, name: str) -> slice:
        if name not in self.objects:
            raise InputError(f"no object {name!r}; there is {', '.join(self.objects)}")
        return self._open.simulation.world.body(name).nodes


def _triple(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = map(float, values)
    return x, y, z


def _with_meshes(table: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a table whose meshes are such as scenes take."""
    objects = table.get("object")
    if not isinstance(objects, list | tuple):
        return dict(table)
    return {**table, "object": [_with_mesh(o) for o in objects]}


def _with_mesh(o: Any) -> Any:
    if isinstance(o, Mapping) and isinstance(mesh := o.get("mesh"), Mesh):
        return {**o, "mesh": mesh.checked}
    return o
