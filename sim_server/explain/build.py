# SPDX-License-Identifier: MIT
"""Builds a scene and notes who asks for kernels, launches and arrays."""

from typing import Any

from numpy.typing import NDArray

from sim_server.backends.base import Backend, EngineInput, Launch, Module
from sim_server.effects._base import Effect
from sim_server.explain.asker import CORE, asker
from sim_server.explain.memory import Memory
from sim_server.mechanics.system import System
from sim_server.mechanics.world import World
from sim_server.scene import Scene
from sim_server.simulation import Simulation, build_effects


class Notes:
    """What was asked for, each with who asked.

    texts: of kernels, in order: (path, asker). kernels: (path, kernel, asker); askers: of launches, by id
    """

    def __init__(self) -> None:
        self.texts: dict[tuple[str, str], None] = {}
        self.kernels: dict[tuple[str, str, str], None] = {}
        self.memory = Memory(World, System, Simulation, NotedBackend)
        self._askers: dict[int, tuple[Launch, str]] = {}

    def bound(self, path: str, launch: Any) -> None:
        """Notes a launch and its arrays."""
        who = asker()
        self._askers[id(launch)] = launch, who
        self.kernels[path, launch.name, who] = None
        for value in launch.values:
            if not isinstance(value, int | float):
                self.memory.take(value, who)

    def asker_of(self, launch: Launch) -> str:
        """Returns who asked for a launch."""
        return self._askers[id(launch)][1] if id(launch) in self._askers else CORE


class NotedModule:
    """A kernel text whose launches are noted."""

    def __init__(self, path: str, module: Module, notes: Notes):
        self._path, self._module, self._notes = path, module, notes

    def __getattr__(self, name: str) -> Any:
        return getattr(self._module, name)

    def bind(self, kernel: str, n: int, **arguments: Any) -> Launch:
        """Returns the launch of `kernel` over n items."""
        launch = self._module.bind(kernel, n, **arguments)
        self._notes.bound(self._path, launch)
        return launch


class NotedBackend:
    """A backend, with notes of who asks it for what."""

    def __init__(self, backend: Backend, notes: Notes):
        self._backend, self._notes = backend, notes

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def module(self, path: str) -> NotedModule:
        """Returns a kernel text, compiled once."""
        self._notes.texts[path, asker()] = None
        return NotedModule(path, self._backend.module(path), self._notes)

    def keep(self, *hosts: NDArray[Any], exact: bool = False) -> None:
        """Declares arrays that stay for the whole run."""
        who = asker()
        for host in hosts:
            self._notes.memory.take(host, who)
        self._backend.keep(*hosts, exact=exact)


class _Built(dict[str, Effect]):
    """Effects by name and variant; their arrays are noted as they are made, also those that they put into the world."""

    def __init__(self, world: World, memory: Memory, names: set[str]):
        super().__init__()
        self._world, self._memory, self._names = world, memory, names

    def __setitem__(self, key: str, effect: Effect) -> None:
        super().__setitem__(key, effect)
        name = max((n for n in self._names if key.startswith(n)), key=len, default=key)
        self._memory.take_all(effect, name)
        self._memory.take_all(self._world, name)


class NotedSimulation(Simulation):
    """A simulation, with notes of who asked for what while it was built.

    given: what its engine runs
    """

    given: EngineInput

    def __init__(self, scene: Scene, device: str = "cpu"):
        self.notes = Notes()
        super().__init__(scene, device)
        for part in (self.world, self.system, self.integrator, self.shape, self.given, self.engine):
            self.notes.memory.take_all(part, CORE)

    def make_backend(self, device: str) -> Backend:
        made: Any = NotedBackend(super().make_backend(device), self.notes)
        return made  # type: ignore[no-any-return]

    def make_effects(self) -> dict[str, Effect]:
        self.notes.memory.take_all(self.world, CORE)
        names = {*self.scene.effects, *(name for o in self.scene.objects for name in o.effects)}
        return build_effects(self.scene, self.world, _Built(self.world, self.notes.memory, names))

    def engine_input(self) -> EngineInput:
        self.given = super().engine_input()
        return self.given
