# SPDX-License-Identifier: MIT
"""What the effects of a scene asked for, as rows: `explain` makes them."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from protocol.channels import SERVER_NAME
from sim_server.backends import compiler
from sim_server.backends.base import Launch
from sim_server.errors import DeviceError, InputError
from sim_server.explain.asker import CORE, Imports, asker
from sim_server.explain.build import NotedBackend, NotedSimulation
from sim_server.explain.topics import topics
from sim_server.scene import load

OURS = ("sim_server", "protocol", "precond_worker")


@dataclass
class Asked:
    """What one effect, or the core, asked for.

    modules: that came with it; of the core ours alone. kernels: by text. native: C++ texts for the host alone
    launches: of a step. arrays, bytes: on the host. device_bytes: of their twins on a GPU
    network, log: keys and channels that are because of it
    """

    name: str
    modules: list[str] = field(default_factory=list)
    kernels: dict[str, list[str]] = field(default_factory=dict)
    native: list[str] = field(default_factory=list)
    launches: int = 0
    arrays: int = 0
    bytes: int = 0
    device_bytes: int = 0
    network: list[str] = field(default_factory=list)
    log: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class LaunchRow:
    """A launch. when: in a step, before or after the solve, or else; items: number of the domain."""

    kernel: str
    domain: str
    items: int
    when: str
    asker: str


@dataclass(frozen=True)
class Explanation:
    """asked: by the core, then by each effect, in the order in which they are built. launches: in their order.

    others: number of modules that are imported for the core and not ours
    """

    scene: str
    device: str
    asked: list[Asked]
    launches: list[LaunchRow]
    others: int

    @property
    def totals(self) -> dict[str, int]:
        """Sums over all that asked."""
        found = {name: 0 for name in ("modules", "texts", "kernels", "launches", "arrays", "bytes", "device_bytes")}
        texts = {text for each in self.asked for text in (*each.kernels, *each.native)}
        kernels = {(text, name) for each in self.asked for text, names in each.kernels.items() for name in names}
        found |= {
            "texts": len(texts),
            "kernels": len(kernels),
            "modules": sum(len(each.modules) for each in self.asked),
        }
        for name in ("launches", "arrays", "bytes", "device_bytes"):
            found[name] = sum(getattr(each, name) for each in self.asked)
        return found | {name: sum(len(getattr(each, name)) for each in self.asked) for name in ("network", "log")}

    def json(self) -> dict[str, Any]:
        """All of it as JSON types."""
        return asdict(self) | {"totals": self.totals}


class _Texts(list[str]):
    """Stands for compiler.compiled: notes who asked for each text."""

    def __init__(self) -> None:
        super().__init__()
        self.askers: list[str] = []

    def append(self, name: str) -> None:
        super().append(name)
        self.askers.append(asker())


def explain(
    path: str | Path, overrides: Sequence[str] = (), device: str = "cpu", server: str = SERVER_NAME
) -> Explanation:
    """Builds a scene and returns what it asked for; whole only in a process that has built none before.

    server: its name in keys of the network
    Raises InputError, DeviceError where there is no such device.
    """
    before = set(sys.modules)
    with Imports() as imports, _texts() as texts:
        scene = load(path, overrides)
        try:
            simulation = NotedSimulation(scene, device)
        except DeviceError:
            raise
        except InputError as error:
            raise InputError(f"scene {scene.path.name}, {error}") from error
        names = [CORE, *dict.fromkeys(e.name for e in simulation.effects.values())]
        asked = {name: Asked(name) for name in names}
        rows = list(_launches(simulation))
        _count(simulation, asked, rows)
        for name, told in topics(simulation, server).items():  # last: their commands make arrays, too
            asked[name].network, asked[name].log = sorted(told.network), sorted(told.log)
    for text, who in zip(texts, texts.askers, strict=True):
        if text.endswith(".cpp"):
            asked[who].native.append(text)
    imported = {name: who for name, who in imports.found.items() if name in sys.modules}
    core = {name for name in before | set(imported) if imported.get(name, CORE) == CORE and ".explain" not in name}
    for name, who in imported.items():
        asked[who].modules.append(name)
    asked[CORE].modules = sorted(name for name in core if name.split(".")[0] in OURS)
    others = len(core) - len(asked[CORE].modules)
    return Explanation(scene.path.name or scene.name, device, list(asked.values()), rows, others)


@contextmanager
def _texts() -> Iterator[_Texts]:
    """Context in which texts that are compiled are noted."""
    noted, all_texts = _Texts(), compiler.compiled
    compiler.compiled = noted
    try:
        yield noted
    finally:
        all_texts += noted
        compiler.compiled = all_texts


def _count(simulation: NotedSimulation, asked: dict[str, Asked], rows: list[LaunchRow]) -> None:
    """Counts kernels, launches and arrays."""
    notes, backend = simulation.notes, simulation.world.backend
    for path, kernel, who in notes.kernels:
        asked[who].kernels.setdefault(path, []).append(kernel.split(".")[1])
    for name, each in asked.items():
        arrays = notes.memory.of(name)
        each.arrays, each.bytes = len(arrays), sum(a.nbytes for a in arrays)
        if isinstance(backend, NotedBackend) and backend.name == "gpu":
            twins = [twin for twin in map(backend.known_twin, arrays) if twin is not None]
            each.device_bytes = sum(int(twin.nbytes) for twin in twins)
        each.launches = sum(row.asker == name and row.when not in BESIDE for row in rows)


BESIDE = ("energy", "before the first step")  # launches that are not of every step


def _launches(simulation: NotedSimulation) -> Iterator[LaunchRow]:
    """Yields the launches in their order, each once, where it comes first."""
    given = simulation.given
    parts = {"stages": given.stages, "backward Euler": given.euler, "substeps": given.substeps}
    lists: dict[str, Sequence[Launch]] = {"before the solve": given.assemble, "after the solve": given.integrate}
    if simulation.scene.integrator.explicit:
        lists = {}  # a step is made of its substeps
    lists = {"before the step": given.history} | lists
    lists |= {when: part.launches for when, part in parts.items() if part is not None}
    lists |= {"before the first step": simulation.engine.begin, "energy": [e.launch for e in given.energies.elastic]}
    seen: set[int] = set()
    for when, launches in lists.items():
        for launch in launches:
            if id(launch) not in seen:
                seen.add(id(launch))
                yield LaunchRow(launch.name, launch.domain, launch.items, when, simulation.notes.asker_of(launch))
