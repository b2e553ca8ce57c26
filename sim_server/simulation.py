# SPDX-License-Identifier: MIT
"""A scene made ready to run: effects built, the launches of a step listed, the native loop set up.

THE STEP is the list made in `launches`: backward Euler with one linearization (Courtecuisse et al. 2010, eq. 5),
    (M - h B - h^2 K) dv = h f + h^2 K v,    v += dv,    x += h v,
unless the scene asks for another integrator (integrator.py). Start reading there.
"""

from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from sim_server.backends.base import Launch
from sim_server.backends.compiler import ahead
from sim_server.backends.cpu.device import Cpu
from sim_server.backends.cpu.engine import Engine, Kind
from sim_server.effects import effect
from sim_server.effects._base import Effect, Refusal
from sim_server.errors import DeviceError, InputError
from sim_server.mechanics.energy import Energies
from sim_server.mechanics.integrator import Integrator
from sim_server.mechanics.shape_matching import ShapeMatching
from sim_server.mechanics.static_check import check_held
from sim_server.mechanics.system import System
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene, load

KINDS = {"none": Kind.NONE, "jacobi": Kind.JACOBI, "block_jacobi": Kind.BLOCK_JACOBI, "ssor": Kind.SSOR}


class Simulation:
    """A scene on a device, "cpu" or "gpu". `engine.run(n)` makes n steps; when factors come is for updates/driver.py.

    watched: whether bodies that run away are looked for at all; a log of a version that did not is repeated without.

    Raises InputError for a scene that cannot be built or a device that is not there.
    """

    def __init__(self, scene: Scene, device: str = "cpu", watched: bool = True):
        self.scene, self._watched = scene, watched
        with _building(device):
            self._build(scene, device)

    def _build(self, scene: Scene, device: str) -> None:
        scene.solver.check_device(device)
        scene.integrator.check_device(device)
        loop = (
            "backends/gpu/loop.cpp" if device == "gpu" else "backends/cpu/native/loop.cpp"
        )  # takes longest to compile
        ahead(loop, *(["backends/cpu/native/factor_check.cpp"] if scene.solver.wants_factors else []))
        self.world = World(scene, _backend(device, scene.solver.precision))
        self.effects = build_effects(scene, self.world)
        elements = [e.elements for e in self.effects.values() if e.elements is not None]
        self.system = System(self.world, elements)
        matched = self._matched()
        self.shape = ShapeMatching(self.world, matched, scene.solver.warp_level) if matched else None
        self.warped = {body.index for body in self._rotated() + matched}  # whose solve is in the material frame
        self.system.warped[:] = [body.index in self.warped for body in self.world.bodies]
        self.integrator = Integrator(scene, self.system)
        if not self.world.inertia:
            check_held(self.world, elements)
        on_runaway = scene.solver.on_runaway if self._watched else None
        still = [self.world.v, self.system.dv, *self.integrator.still]
        self.energies = Energies(self.world, self.effects, self.integrator.before, still, on_runaway)
        assemble, integrate = self.launches()
        w, s = self.world, self.system
        arrays: dict[str, Any] = {"row_start": s.row_start, "columns": s.columns, "values": s.values}
        arrays |= {"b": s.b_material, "y": s.y, "x": w.x, "v": w.v, "clock": s.clock, "moving": s.moving}
        ranges = [(b.first, b.last) for b in w.bodies]
        newton = self.integrator.newton(assemble, list(self.effects.values()))
        self.engine: Any
        launches: tuple[Any, Any] = assemble, integrate  # of the kind that the engine runs
        if device == "gpu":
            from sim_server.backends.gpu.engine import GpuEngine

            gpu: Any = w.backend
            names = [b.name for b in w.bodies]
            planes = 2 if scene.solver.factor_precision == "float32" else 1
            self.engine = GpuEngine(
                gpu, *launches, ranges, w.dt, self.energies, names, planes=planes, newton=newton, **arrays
            )
        else:
            threads = scene.solver.threads
            self.engine = Engine(
                *launches, ranges, w.dt, threads=threads, newton=newton, energies=self.energies, **arrays
            )
        self.engine.begin = self.integrator.begin(assemble)
        for body in w.bodies:
            self._settle(body)

    @classmethod
    def load(cls, path: str | Path, overrides: Sequence[str] = (), device: str = "cpu") -> "Simulation":
        """From a scene file."""
        scene = load(path, overrides)
        try:
            return cls(scene, device)
        except DeviceError:
            raise
        except InputError as error:
            raise InputError(f"scene {scene.path.name}, {error}") from error

    def fetch(self) -> World:
        """The world with positions and velocities as they are on the device now."""
        for array in (self.world.x, self.world.v):
            self.world.backend.fetch(array)
        return self.world

    def launches(self) -> tuple[list[Launch], list[Launch]]:
        """What a step runs: before and after the solve."""
        system = self.system
        assemble = [self.integrator.start()]
        stencils = iter(system.stencils)
        accumulate = False
        for e in sorted(self.effects.values(), key=lambda e: e.elements is None):  # touch asks what the elements added
            stencil = next(stencils) if e.elements is not None else None
            assemble += e.launches(system, stencil, accumulate)  # f and K, M, B of each effect
            accumulate = accumulate or stencil is not None
        if self.shape is not None:
            assemble.append(self.shape.launch(system.mean))
        assemble += system.finish()  # into the material frame (eq. 12 and 13)
        return assemble, [self.integrator.advance()]

    def _rotated(self) -> list[Body]:
        """Bodies whose rotations for the warp are those of elements."""
        if not self.scene.solver.warp:
            return []
        return [body for e in self.effects.values() for body in e.rotated]

    def _matched(self) -> list[Body]:
        """Bodies with elements none of which have rotations: theirs are matched shapes."""
        if not self.scene.solver.warp:
            return []
        rotated = {body.index for body in self._rotated()}
        return [b for b in self.world.bodies if b.index not in rotated and self.system.couples(b.first, b.last)]

    def _settle(self, body: Body) -> None:
        solver, native = self.scene.solver, self.engine.settings(body.index)
        native.tolerance, native.max_iterations = solver.tolerance, solver.max_iterations
        native.budget, native.warm_start = solver.budget, int(solver.warm_start)
        if solver.woodbury and solver.wants_factors and "touch" in body.effects and isinstance(self.engine, Engine):
            double = solver.factor_precision == "float64"
            self.engine.correct(body.index, solver.woodbury, self.system.diagonal, double)
        native.kind, native.omega = KINDS.get(solver.preconditioner, Kind.CHOLESKY), solver.omega

    def refusals(self) -> list[Refusal]:
        """Elements in states that their law does not define, by the time at which they had them first."""
        found = [r for e in self.effects.values() for r in e.refusals()]
        return sorted(found, key=lambda r: r.time)

    def potential_energy(self) -> float:
        """Of all effects [J]."""
        self.fetch()
        return sum(e.energy() for e in self.effects.values())

    def kinetic_energy(self) -> float:
        """m v^2 / 2 of all nodes [J]."""
        self.fetch()
        return 0.5 * float(self.world.mass @ (self.world.v**2).sum(axis=1))

    def matrix(self, body: int = 0) -> Any:
        """A' of a body as it was last assembled, scipy.sparse (3 n, 3 n)."""
        from scipy.sparse import bsr_array

        b = self.world.bodies[body]
        row_start, columns = self.system.body_pattern(b.first, b.last)
        n = 3 * (b.last - b.first)
        return bsr_array((self.system.body_values(b.first, b.last).copy(), columns, row_start), shape=(n, n)).tocsc()


def _building(device: str) -> AbstractContextManager[None]:
    if device == "gpu":
        from sim_server.backends.gpu.device import building

        return building()
    return nullcontext()


def _backend(device: str, precision: str) -> Any:
    if device == "gpu":
        from sim_server.backends.gpu.device import Gpu

        return Gpu(precision)
    return Cpu()


def build_effects(scene: Scene, world: World) -> dict[str, Effect]:
    """The effects that the scene lists, and no others, by name (and variant)."""
    built: dict[str, Effect] = {}
    for name in sorted({n for o in scene.objects for n in o.effects}):
        variants: dict[str, list[tuple[Body, Any]]] = {}
        for body, params in world.with_effect(name):
            variants.setdefault(getattr(params, "variant", ""), []).append((body, params))
        for variant, listed in variants.items():
            built[name + variant] = effect(name).build(world, listed)
    for name, params in scene.effects.items():
        built[name] = effect(name).build(world, [(body, params) for body in world.bodies])
    return built
