# SPDX-License-Identifier: MIT
"""Start reading here: a scene made ready to run, its effects built and the kernels of a step listed for the engine.

THE STEP is the list made in `launches`: backward Euler with one linearization (Courtecuisse et al. 2010, eq. 5),
    (M - h B - h^2 K) dv = h f + h^2 K v,    v += dv,    x += h v,
unless the scene asks for another integrator (mechanics/integrator.py). The engine (backends/base.py) runs it.

matrix  updates/driver.py has the engine copy one (`request_matrix`); network/dispatch.py sends it to a worker
factor  comes back to updates/driver.py, which checks it and gives it to the engine (`post_factor`)
push    service/commands.py carries it out on effects/touch.py, which calls `update_effect` here
record  service/telemetry.py fetches those of the engine (`records`) for recording/recorder.py and network/publishers.py
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from sim_server import backends
from sim_server.backends.base import Backend, Capability, EngineInput, Launch, PendingUpdate
from sim_server.backends.compiler import ahead
from sim_server.backends.halving import Halving
from sim_server.backends.kinds import FACTOR_TRUST, WARPED_TRUST, Kind
from sim_server.backends.measured import Measured
from sim_server.backends.rank_one import RankOne
from sim_server.effects import effect
from sim_server.effects._base import Effect, Refusal
from sim_server.errors import DeviceError, InputError
from sim_server.mechanics.energy import collected_energies
from sim_server.mechanics.guess import make_guess
from sim_server.mechanics.halving import check_memory, halving, time_steps
from sim_server.mechanics.rosenbrock import RosenbrockIntegrator, make_integrator
from sim_server.mechanics.shape_matching import ShapeMatching
from sim_server.mechanics.split_history import SplitHistory
from sim_server.mechanics.static_check import check_held
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.ties import make_ties, ties_alone
from sim_server.mechanics.world import Body, World
from sim_server.parameters import LiveParameters
from sim_server.scene import Scene, load
from sim_server.scene.size_limits import NO_LIMITS, SizeLimits

if TYPE_CHECKING:
    from scipy.sparse import csc_array

    from sim_server.effects._holders import Holders  # imported where a scene has them
    from sim_server.effects._movable import Movable
    from sim_server.effects.contact import Contact  # imported where a scene lists it
    from sim_server.effects.cutting import Cutting  # likewise
    from sim_server.effects.touch import Touch  # imported where a scene lists it

KINDS = {"none": Kind.NONE, "jacobi": Kind.JACOBI, "block_jacobi": Kind.BLOCK_JACOBI, "ssor": Kind.SSOR}


class Simulation:
    """A scene on a device, "cpu" or "gpu". `engine.run(n)` makes n steps; when factors come is for updates/driver.py.

    watched: whether bodies that run away are looked for at all; a log of a version that did not is repeated without.

    Raises InputError for a scene that cannot be built or a device that is not there.
    """

    def __init__(self, scene: Scene, device: str = "cpu", watched: bool = True):
        self.scene = scene
        scene.check_device(device)
        backend = self.make_backend(device)
        ahead("updates/update_table.cpp")
        if scene.solver.wants_factors:
            ahead("backends/cpu/native/factor_check.cpp")
        self.on_effect_update: list[Callable[[Effect, PendingUpdate], None]] = []
        self._mailed: dict[Effect, int] = {}  # numbers of their launches whose arguments may change
        self._stages_of_holders: list[list[Launch]] = [[], []]  # their launches in the second stage, and after it
        self._detection = slice(0, 0)  # numbers of those that detect contacts
        with backend.building():
            self._build(backend, watched)
        self.parameters = LiveParameters(self)
        self.splits: SplitHistory | None = None
        if self.system.followed is not None:
            self.splits = SplitHistory(self.system)
            self.parameters.before_loop.append(self.splits.on_set)

    def make_backend(self, device: str) -> Backend:
        """Returns the place where the kernels of this scene run."""
        return backends.create(device, self.scene.solver.precision)

    def make_effects(self) -> dict[str, Effect]:
        """Returns the effects that the scene lists, and no others, by name (and variant)."""
        return build_effects(self.scene, self.world)

    def _build(self, backend: Backend, watched: bool) -> None:
        scene, solver = self.scene, self.scene.solver
        self.world = World(scene, backend)
        self.effects = self.make_effects()
        self.ties = self.contact.contact_input().ties if self.contact else make_ties(self.world)
        if self.holders and self.touch:
            self.holders.use_load(self.touch.force)
        self.fixed = self.world.free == 0  # at the start, when the pattern of A is made; later nodes may come to rest
        elements = [e.elements for e in self.effects.values() if e.elements is not None and e.holds]
        self.system = System(self.world, [e.coupled for e in self.effects.values() if e.coupled is not None])
        matched = self._matched()
        self.system.guess = make_guess(scene, self.world, self.system.dv)
        self.shape = ShapeMatching(self.world, matched, solver.warp_level) if matched else None
        self.warped = {body.index for body in self.rotated_bodies() + matched}  # whose solve is in the material frame
        self.system.warped[:] = [body.index in self.warped for body in self.world.bodies]
        self.integrator = make_integrator(scene, self.system)
        if not self.world.inertia:
            check_held(self.world, elements)
        self._held_launches = self._hold()
        still = [self.world.v, self.system.dv, *self.integrator.still]
        on_runaway = solver.on_runaway if watched else None
        self.energies = collected_energies(self.world, self.effects, self.integrator.before, still, on_runaway)
        given = self.engine_input()
        self.engine = backend.engine(given)
        self.engine.begin = self.integrator.begin(given.assemble[len(self._held_launches) :])
        for e in self.effects.values():
            e.connect(self)
        for body in self.world.bodies:
            self._settle(body)

    def engine_input(self) -> EngineInput:
        """Returns what an engine runs: the launches of a step and the arrays of the solve."""
        w, s = self.world, self.system
        arrays: dict[str, NDArray[Any]] = {"row_start": s.row_start, "columns": s.columns, "values": s.values}
        arrays |= {"b": s.b_material, "y": s.y, "x": w.x, "v": w.v, "clock": s.clock, "moving": s.moving}
        arrays["rotation"] = s.rotation
        names, ranges = [b.name for b in w.bodies], [(b.first, b.last) for b in w.bodies]
        others = self._other_launches()
        assemble, integrate = self.launches()
        mailed = {x.name: x for x in assemble if x.mailed}  # whose arguments come to one launch, which all lists share
        own = {id(x): x for x in assemble}
        *lists, euler_launches, settled = [[own.get(id(x)) or mailed.get(x.name, x) for x in o] for o in others]
        effects, numbers = list(self.effects.values()), self._detection
        newton = self.integrator.newton(assemble, numbers, effects)
        stages = self.integrator.stages(assemble, lists, effects)
        substeps = self.integrator.substeps(len(self._held_launches))
        euler = self.integrator.euler_form(
            [*assemble, *integrate], assemble[numbers], euler_launches, settled, effects
        )  # fmt: skip
        histories = [(e.name, e.history()) for e in effects]
        history = [launch for _, launches in histories for launch in launches]
        short = None
        if self.energies.on_runaway == "halve":
            check_memory(histories)
            short = self._halving(mailed, effects)
        parts = [part.launches for part in (stages, euler, substeps, short) if part]
        listed = (*history, *assemble, *integrate, *(x for p in parts for x in p))
        self.step_launches = list({id(x): x for x in listed}.values())
        contact = ties_alone(w, self.ties) if self.ties else None
        if self.contact:
            contact = self.contact.contact_input()
        touch = assemble[self._mailed[self.touch]] if self.touch else None
        held = w.reaction if w.reaction.size else None
        return EngineInput(
            assemble, integrate, names, ranges, w.dt, self.scene.solver, self.energies, newton, stages, euler, substeps,
            contact, touch, held, self.scene.accuracy is not None, self._rank_one(), arrays, history,
            self.cutting.cut_input(s, self.integrator.carried) if self.cutting else None, self.measured, short,
        )  # fmt: skip

    def _halving(self, mailed: Mapping[str, Launch], effects: list[Effect]) -> Halving:
        """Returns the short steps of bodies that ran away. mailed: launches that all lists share, by name."""
        assemble, advance = [], []
        for dt in time_steps(self.world):
            with self.world.made_with(dt, dt, usual_tangent=False):
                assemble.append([mailed.get(x.name, x) for x in self.launches(detect=False, euler=True)[0]])
                advance.append(self.system.advance(self.integrator.before))
        touched = self.touch.only if self.touch else None
        return halving(self.integrator, assemble, advance, effects, self.energies.touch.values(), touched)

    def _rank_one(self) -> RankOne | None:
        """Returns the parts of A beside its blocks; one effect at most has some."""
        found = [part for e in self.effects.values() if (part := e.rank_one()) is not None]
        return found[0] if found else None

    @classmethod
    def load(
        cls, path: str | Path, overrides: Sequence[str] = (), device: str = "cpu", limits: SizeLimits = NO_LIMITS
    ) -> "Simulation":
        """From a scene file. Raises InputError, also for one beyond the limits."""
        scene = load(path, overrides)
        try:
            limits.check(scene, backends.bytes_of_copies(device, scene.solver.precision))
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

    def launches(
        self, matrix: bool = True, detect: bool = True, euler: bool = False
    ) -> tuple[list[Launch], list[Launch]]:
        """What a step runs: before and after the solve.

        matrix: takes A into the material frame; detect: detects contacts; euler: a step of backward Euler that bodies
        take in place of that of the scheme
        """
        system = self.system
        assemble = [*(self._hold(euler=True) if euler else self._held_launches), self.integrator.start()]
        if self.holders and self._held_launches and not euler:
            self._mailed[self.holders] = 0
        stencils = iter(system.stencils)
        accumulate = False
        for e in sorted(self.effects.values(), key=_order):
            stencil = next(stencils) if e.elements is not None else None
            if e is self.contact and not detect:
                continue
            explicit = self.world.explicit  # f alone, else f and K, M, B of each effect
            added = self._forces_of(e, stencil) if explicit else e.launches(system, stencil, accumulate)
            if e is self.contact:
                self._detection = slice(len(assemble), len(assemble) + len(added))
            for number, launch in enumerate(added, len(assemble)):
                if launch.mailed:
                    self._mailed[e] = number
            assemble += added
            accumulate = accumulate or stencil is not None
        if self.shape is not None:
            assemble.append(self.shape.launch(system.mean))
        if self.world.explicit:
            assemble += system.keep_directions(frames=False)
        else:
            assemble += system.finish(matrix, guessed=not euler)  # into the material frame (eq. 12 and 13)
        settled = self.holders.last_launches(system) if self.holders and not self.integrator.has_stages else []
        guess = [] if system.guess is None or euler else [system.guess.extrapolate()]
        return assemble, [*settled, *self.integrator.advance(), *guess]

    def _forces_of(self, effect: Effect, stencil: Stencil | None) -> list[Launch]:
        """Returns the launches that add the forces of an effect: those without A, or all but the blocks of A."""
        forces = effect.force_launches(self.system, stencil, False)
        if forces is not None:
            return forces
        return [x for x in effect.launches(self.system, stencil, False) if x.domain != "blocks"]

    def _hold(self, euler: bool = False) -> list[Launch]:
        """Returns the launches that move holders and their nodes, of a step of the scheme or of backward Euler. The
        first is the same in both, and mailed."""
        if self.holders is None:
            return []
        i = self.integrator
        if isinstance(i, RosenbrockIntegrator) and not euler:
            first, *self._stages_of_holders = self.holders.stage_launches(self.system, i)
            return first
        made = self.holders.first_launches(self.system, i.beta, i.inertial_increment, euler)
        return [*self._held_launches[:1], *made] if euler else made

    def _other_launches(self) -> list[list[Launch]]:
        """Returns what steps run beside `launches`: the forces of the stages of ros2 and what follows them, the
        assembly of backward Euler, and what settles the forces of holders there.

        Where bodies touch, with the tangent that backward Euler has by default: the exact one would take their spin.
        """
        stages: list[list[Launch]] = []
        if self.integrator.has_stages:
            second, end = self._stages_of_holders
            stages = [[*self._held_launches, *self.force_launches(True)], [*second, *self.force_launches(False)], end]
        if not self.integrator.takes_euler:
            return [*stages, [], []]
        with self.world.made_with(self.world.dt, self.world.dt, usual_tangent=self.integrator.touches):
            assemble = self.launches(detect=False, euler=True)[0]
            settled = self.holders.last_launches(self.system, euler=True) if self.holders else []
        return [*stages, assemble, settled]

    def force_launches(self, frames: bool) -> list[Launch]:
        """Returns the launches of a stage that needs no A. frames: those of the nodes are made, too."""
        stencils = iter(self.system.stencils)
        ordered = sorted(self.effects.values(), key=_order)
        parts = [
            e.force_launches(self.system, next(stencils) if e.elements is not None else None, frames) for e in ordered
        ]
        if any(part is None for part in parts):  # then all that `launches` has but for the blocks
            full = self.launches(matrix=False, detect=False)[0][len(self._held_launches) :]
            full = [x for x in full if x.domain != "blocks"]
            last = len(self.system.finish(matrix=False))
            return full if frames else full[:-last] + self.integrator.rotate_force()
        shape = [self.shape.launch(self.system.mean)] if frames and self.shape is not None else []
        finish = self.system.finish(matrix=False) if frames else self.integrator.rotate_force()
        return [self.integrator.start_forces(), *(x for part in parts for x in part or ()), *shape, *finish]

    def update_effect(self, effect: Effect, launch: Launch) -> PendingUpdate:
        """Gives the mailed launch of an effect other arguments, those of `launch`, from one of the next steps on.

        This is the one way in which an effect changes while steps run. Each of `on_effect_update` is then called.
        """
        pending = self.engine.replace(self._mailed[effect], launch)
        for observe in self.on_effect_update:
            observe(effect, pending)
        return pending

    @property
    def touch(self) -> "Touch | None":
        """Pushes and grabs, if the scene lists them."""
        return cast("Touch | None", self.effects.get("touch"))

    @property
    def cutting(self) -> "Cutting | None":
        """Elements that are removed, if the scene lists it."""
        return cast("Cutting | None", self.effects.get("cutting"))

    def epoch(self, name: str, step: int) -> int:
        """Returns the epoch of an object in the matrix assembled after `step` completed steps: one more with each time
        that it was split."""
        return 1 if self.splits is None else self.splits.at(name, step)

    @property
    def contact(self) -> "Contact | None":
        """Contact with obstacles, if the scene lists it."""
        return cast("Contact | None", self.effects.get("contact"))

    @property
    def holders(self) -> "Holders | None":
        """Groups of nodes that move as rigid bodies, if the scene has them."""
        return cast("Holders | None", self.effects.get("holders"))

    @property
    def movers(self) -> "list[Movable]":
        """The effects that move obstacles and holders."""
        return [m for m in (self.contact, self.holders) if m is not None]

    def movable(self, name: str) -> "Movable | None":
        """Returns the effect that moves the obstacle or holder of this name; an unknown name may be any's."""
        named = name in {h.name for h in self.world.holders}
        return self.holders if named or self.contact is None else self.contact

    @property
    def posed_names(self) -> list[str]:
        """Names of what has a pose and is no object: obstacles, then holders."""
        return [each.name for each in (*self.world.obstacles, *self.world.holders)]

    @property
    def reaction_names(self) -> list[str]:
        """Names of what objects exert forces on, in the order of the engine's reactions."""
        w = self.world
        return [*self.posed_names, *(a.name for a in w.attachments), *(s.name for s in w.springs)]

    @cached_property
    def measured(self) -> list[Measured]:
        """Numbers that the records of steps come with, in the order of bodies."""
        return sorted((m for e in self.effects.values() for m in e.measured()), key=lambda m: m.body)

    def rotated_bodies(self) -> list[Body]:
        """Bodies whose rotations for the warp are those of elements."""
        if not self.scene.solver.warp:
            return []
        return [body for e in self.effects.values() for body in e.rotated]

    def _matched(self) -> list[Body]:
        """Bodies with elements none of which have rotations: theirs are matched shapes."""
        if not self.scene.solver.warp:
            return []
        rotated = {body.index for body in self.rotated_bodies()}
        return [b for b in self.world.bodies if b.index not in rotated and self.system.couples(b.first, b.last)]

    def _settle(self, body: Body) -> None:
        solver, settings = self.scene.solver, self.engine.settings(body.index)
        settings.tolerance, settings.max_iterations = solver.tolerance, solver.max_iterations
        settings.budget, settings.warm_start = solver.budget, int(solver.warm_start)
        settings.kind, settings.omega = KINDS.get(solver.preconditioner, Kind.CHOLESKY), solver.omega
        accuracy, settings.dx_dv = self.scene.accuracy, self.world.dx_dv / self.world.balance_point
        settings.position = accuracy.position_of(body.mesh.rest) if accuracy else 0.0
        settings.trust = WARPED_TRUST if body.index in self.warped else FACTOR_TRUST
        settings.step_budget = solver.step_budget
        alone = self.scene.uses_factor_alone  # then the loop has to know what a factor lacks
        corrects = (solver.woodbury or alone) and solver.wants_factors and ("touch" in body.effects or self.contact)
        if corrects and Capability.LOW_RANK_UPDATE in self.engine.capabilities:
            double = solver.factor_precision == "float64"
            block = self.system.block if alone else None
            self.engine.correct(body.index, solver.woodbury or 1, self.system.diagonal, double, block)

    def refusals(self) -> list[Refusal]:
        """Elements in states that their law does not define, by the time at which they had them first."""
        found = [r for e in self.effects.values() for r in e.refusals()]
        return sorted(found, key=lambda r: r.time)

    def potential_energy(self) -> float:
        """Returns the potential energy of all effects at the present state [J]."""
        self.fetch()
        return sum(e.energy() for e in self.effects.values())

    def kinetic_energy(self) -> float:
        """m v^2 / 2 of all nodes [J]."""
        self.fetch()
        return 0.5 * float(self.world.mass @ (self.world.v**2).sum(axis=1))

    def matrix(self, body: int = 0) -> "csc_array[np.float64]":
        """A' of a body as it was last assembled, (3 n, 3 n)."""
        from scipy.sparse import bsr_array

        b = self.world.bodies[body]
        row_start, columns = self.system.body_pattern(b.first, b.last)
        n = 3 * (b.last - b.first)
        return bsr_array((self.system.body_values(b.first, b.last).copy(), columns, row_start), shape=(n, n)).tocsc()


def _order(effect: Effect) -> tuple[bool, bool]:
    """Returns the place of an effect's launches: those of elements come before touch, which asks what they added."""
    return not effect.comes_first, effect.elements is None


def build_effects(scene: Scene, world: World, built: dict[str, Effect] | None = None) -> dict[str, Effect]:
    """The effects that the scene lists, and no others, by name (and variant). built: takes each as it is made."""
    built = {} if built is None else built
    if world.holders:
        from sim_server.effects._holders import Holders

        built["holders"] = Holders(world)
    names = {n for o in scene.objects for n in o.effects}
    for name in sorted(names, key=lambda name: (name == "cutting", name)):  # cutting takes the masses of all others
        variants: dict[str, list[tuple[Body, Any]]] = {}
        for body, params in world.with_effect(name):
            variants.setdefault(params.variant_of(body.elements), []).append((body, params))
        for variant, listed in variants.items():
            built[name + variant] = effect(name).build(world, listed)
            built[name + variant].name = name
    for name, params in sorted(scene.effects.items(), key=lambda item: item[0] != "gravity"):  # contact asks for it
        built[name] = effect(name).build(world, [(body, params) for body in world.bodies])
        built[name].name = name
    if "cutting" in built:
        cast("Cutting", built["cutting"]).check(built)
    for each in built.values():
        each.join(list(built.values()))
    return built
