# SPDX-License-Identifier: MIT
"""Changes parameters of a scene while steps run: checks them as at the start, gives the loop new contents of arrays.

What may change is marked beside its field (scene/live.py). A new value goes into a copy of its table, with which
the scene is validated as a whole; what differs afterwards must be what was set. The arrays that follow these parameters
(World.follow) are computed by the functions that made them, and the loop copies the results into them between two
steps, without Python: launches, their arguments, factors and histories stay as they are. A factor of other parameters
is an older factor.
"""

import json
import logging
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from pydantic import BaseModel, ValidationError

from sim_server.backends.base import Engine, PendingUpdate, StagedChange
from sim_server.effects._base import Effect
from sim_server.errors import InputError
from sim_server.mechanics.world import World
from sim_server.scene import Scene, SceneObject, overrides
from sim_server.scene.live import LiveField, Place, live_fields
from sim_server.scene.messages import NAMED, readable
from sim_server.scene.obstacles import Obstacle
from sim_server.scene.parameters import nearest
from sim_server.scene.regions import Selection

log = logging.getLogger(__name__)

REASONS = {  # why keys cannot change while steps run, by how they begin
    "dt": "the time step is an argument of every kernel and of the clock",
    "mesh": "all arrays are of the size of the mesh",
    "pose": "it is where the object begins",
    "density": "masses are taken when the simulation is built",
    "mass": "masses are taken when the simulation is built",
    "effects": "the kernels of a step are chosen by it when the simulation is built",
    "integrator": "the kernels of a step are chosen by it when the simulation is built",
    "solver": "solver, factors and workers are set up by it when the simulation is built",
}
OTHER_REASON = "it is read when the simulation is built"


class Simulated(Protocol):
    """A simulation, as far as its parameters change."""

    scene: Scene
    world: World
    effects: dict[str, Effect]
    engine: Engine


class BadParameter(ValueError):
    """A parameter that is refused; the text is for the client."""


@dataclass(frozen=True)
class LiveParameter:
    """A live parameter with its present value.

    text: the value as TOML; low, high: of a slider, equal without one
    """

    field: LiveField
    text: str
    low: float
    high: float


@dataclass
class ParameterUpdate:
    """New values on their way to the loop, by key, as TOML.

    pending: None until they have been given to it. replaces: an update that the loop has not taken up and that is part
    of this one. No values: those of the update that it replaces are taken back, the loop has these
    """

    values: dict[str, str]
    client: str
    pending: PendingUpdate | None = None
    replaces: "ParameterUpdate | None" = None

    @property
    def taken(self) -> int:
        """Steps completed when the loop took them up; negative: not yet, or never if newer ones came."""
        return -1 if self.pending is None else self.pending.taken


class LiveParameters:
    """The parameters of a simulation that may change, and their present values.

    scene: the scene with the values that were set last
    on_set: called with each update that was given to the loop
    before_loop: called with each update, and the scene with it, before the loop can take it up
    """

    def __init__(self, simulation: Simulated):
        self._simulation, self.scene = simulation, simulation.scene
        self.on_set: list[Callable[[ParameterUpdate], None]] = []
        self.before_loop: list[Callable[[ParameterUpdate, Scene], None]] = []
        self._start = {field.key: field.value for field in live_fields(self.scene)}
        self._taken = self.scene  # with the values that the loop has if it does not take up what waits
        self._waiting: dict[int, StagedChange] = {}  # by id of the array: what the loop was given last
        self._update: ParameterUpdate | None = None  # likewise
        self._first: ParameterUpdate | None = None  # the first one that the loop took up, or is to

    def __iter__(self) -> Iterator[LiveParameter]:
        """All live parameters that the scene gives a value, and that are listed."""
        for field in live_fields(self.scene):
            if field.live.listed:
                yield self._described(field)

    @property
    def changed(self) -> dict[str, str]:
        """Values that are not those of the start, by key, as TOML."""
        return {f.key: toml(_plain(f.value)) for f in live_fields(self.scene) if f.value != self._start.get(f.key)}

    def set(self, values: Mapping[str, str], client: str = "") -> list[LiveParameter]:
        """Sets parameters, all between the same two steps; returns them.

        values: TOML, by key as after --set (object.NAME.effects.EFFECT.KEY) or a short one (NAME.EFFECT.KEY); with
            [REGION] behind it that of one region, which may be any constant that regions have

        Raises BadParameter; nothing changes then.
        """
        fields = {field.key: field for field in live_fields(self.scene)}
        given: dict[str, LiveField] = {}
        written: dict[str, tuple[str, str]] = {}  # by full key with region: as it was given, and its value
        for key, text in values.items():
            short, region = overrides.region_of(key)
            field = (region and _with_regions(short, fields)) or self._found(short, text, fields)
            whole = f"{_table(field.key)}.{_name(short)}[{region}]" if region else field.key
            if whole in written or (field.key in given and not (region and field.key not in written)):
                raise BadParameter(f"{whole} is set twice")
            written[whole], given[field.key] = (key, text), field
        draft = _draft(self.scene, [f.place for f in given.values()])
        for whole, (key, text) in written.items():
            try:
                overrides.assign(whole, overrides.value(text.strip()), text, draft)
            except InputError as error:
                raise BadParameter(f"{key} = {text}: {error}") from None
        scene = self._validated(draft)
        new = {f.key: f for f in live_fields(scene) if f.key in given}
        if len(new) < len(given):
            raise BadParameter(f"{', '.join(given.keys() - new.keys())}: needs a value")
        changed = [f for f in new.values() if _plain(f.value) != _plain(given[f.key].value)]
        self._check(scene, draft, changed)
        if changed:
            self._give(scene, changed, client)
        return [self._described(new[key]) for key in given]

    def take_back(self, keys: Iterable[str]) -> None:
        """Sets those of these parameters that have changed to what they were at the start."""
        if keys := set(keys) & self.changed.keys():
            self.set({key: toml(_plain(self._start[key])) for key in keys})

    def known_to_workers_at(self, step: int) -> bool:
        """True if the matrix assembled after `step` completed steps has the parameters of the start."""
        first = self._first
        return first is None or (first.pending is not None and not 0 <= first.taken <= step)

    @property
    def known_to_workers(self) -> bool:
        """True if no parameter was set: workers that assemble matrices know those of the start."""
        return self._first is None

    def _found(self, key: str, text: str, fields: Mapping[str, LiveField]) -> LiveField:
        found = [f for f in fields.values() if key in (f.key, f.short)]
        exact = [f for f in found if f.key == key] or found
        if len(exact) == 1:
            return exact[0]
        if exact:
            raise BadParameter(f"{key} may be {' or '.join(f.key for f in exact)}; write one of these")
        short = sorted(f.short for f in fields.values())
        allowed = f"live parameters: {', '.join(short[:20]) or 'none'}{', ...' if len(short) > 20 else ''}"
        reason = self._reason(key)
        if reason:
            raise BadParameter(f"{key} = {text[:80]}: cannot change while steps run, since {reason}; {allowed}")
        raise BadParameter(f"no parameter {key!r}" + nearest(key, short[:100], "live parameters"))

    def _reason(self, key: str) -> str:
        """Returns why the value of a key of the scene cannot change; "" if there is no such key."""
        scene, effects = self.scene, self.scene.effects
        tables: list[tuple[str, Callable[[str], Any]]] = [("", partial(_field, scene))]
        tables += [(begin, effects.get) for begin in ("effects.", "")]
        for o in scene.objects:  # NAME.KEY, NAME.EFFECT.KEY
            for begin in (f"object.{o.name}.", f"{o.name}."):
                tables += [(begin, partial(_field, o)), (begin, o.effects.get)]
        for listed in (scene.obstacles, scene.holders, scene.attachments, scene.springs):
            for named in listed or ():
                kind = type(named).__name__.lower()
                tables += [(f"{begin}{named.name}.", partial(_field, named)) for begin in (f"{kind}.", "")]
        for begin, find in tables:
            if key.startswith(begin):
                first, *path = key.removeprefix(begin).split(".")
                if _at(_plain(find(first)), path) is not None:
                    return next((why for name, why in REASONS.items() if first == name), OTHER_REASON)
        return ""

    def _validated(self, draft: dict[str, Any]) -> Scene:
        """Returns the scene with the tables of a draft, validated as a whole. Raises BadParameter."""
        table = {field.alias or name: getattr(self.scene, name) for name, field in Scene.model_fields.items()}
        for kind, new in draft.items():
            whole = isinstance(new, dict)
            table[kind] = new if whole else [n if len(n) > 1 else o for n, o in zip(new, table[kind], strict=True)]
        try:
            return Scene.model_validate({k: v for k, v in table.items() if v is not None}, context={"files": "known"})
        except ValidationError as error:
            names = {kind: [_named(each) for each in table[kind] or ()] for kind in NAMED}
            raise BadParameter(str(readable(error, "", names | draft)).removeprefix("scene , ")) from None

    def _check(self, scene: Scene, draft: Mapping[str, Any], changed: Sequence[LiveField]) -> None:
        """Raises BadParameter for what cannot change while steps run."""
        places = [field.place for field in changed]
        old, new = _draft(self.scene, places, draft), _draft(scene, places, draft)
        for name in Scene.model_fields.keys() - {"effects", "objects", "obstacles"}:
            old[name], new[name] = getattr(self.scene, name), getattr(scene, name)
        for place in _differing(old, new):
            if not any(place[: len(p)] == p for p in places):
                raise BadParameter(f"would change {'.'.join(map(str, place))}, which cannot change while steps run")
        for effect in self._simulation.effects.values():
            why = effect.unchangeable(scene)
            for f in changed:
                body = f.place[1] if f.place[0] == "object" else -1
                if f.of == effect.name and (reason := why.get((int(body), str(f.place[-1])))):
                    raise BadParameter(f"{f.key}: cannot change to this value, since {reason}")

    def _give(self, scene: Scene, changed: Sequence[LiveField], client: str) -> None:
        """Has the loop copy the arrays that follow what changed."""
        tables = {field.of for field in changed}
        simulation = self._simulation
        try:
            new = [(a.array, np.ascontiguousarray(a.compute(scene))) for a in simulation.world.live_arrays
                   if tables & set(a.of)]  # fmt: skip
            elastic = {e: e.elastic_in(scene) for e in simulation.effects.values() if e.name in tables}
            for array, contents in new:
                if contents.shape != array.shape or contents.dtype != array.dtype:
                    raise BadParameter("would change the size of an array")
                if not np.isfinite(contents).all():
                    raise BadParameter("gives values that are not finite")
            with simulation.world.backend.building():
                staged = simulation.engine.stage(new)
        except InputError as error:
            raise BadParameter(str(error)) from None
        update, keys = ParameterUpdate({}, client), {f.key for f in changed}
        before, withdrawn = (self.scene, self._update, self._waiting, self._first), False
        try:
            if withdrawn := simulation.engine.withdraw_changes():
                assert self._update is not None
                update.replaces = self._update
                keys |= self._update.values.keys()
                if self._first is self._update:
                    self._first = None
            else:
                self._waiting, self._taken = {}, self.scene
            self._waiting = self._waiting | {id(array): each for (array, _), each in zip(new, staged, strict=True)}
            self._update, self.scene = update, scene
            has = {f.key: _plain(f.value) for f in live_fields(self._taken) if f.key in keys}
            news = [f for f in live_fields(scene) if f.key in keys and _plain(f.value) != has.get(f.key)]
            if news:
                self._post(update, news)
        except Exception:
            self.scene, self._update, self._waiting, self._first = before
            if withdrawn:
                self._post_again()
            raise
        if update.replaces is not None:
            update.replaces.replaces = None  # keep no chain of them
        for effect, found in elastic.items():
            effect.elastic = found
        for observe in self.on_set:
            observe(update)

    def _post(self, update: ParameterUpdate, news: Sequence[LiveField]) -> None:
        """Gives an update to the loop. news: what the loop does not have; a replay knows of nothing else."""
        update.values = {f.key: toml(_plain(f.value)) for f in news}
        if self._first is None:
            self._first = update  # before the loop may take it up
        tables = {f.of for f in news}
        follow = [id(a.array) for a in self._simulation.world.live_arrays if tables & set(a.of)]
        for note in self.before_loop:
            note(update, self.scene)
        update.pending = self._simulation.engine.change([self._waiting[k] for k in dict.fromkeys(follow)])

    def _post_again(self) -> None:
        """Gives the loop back the update that was withdrawn for one that failed. If that fails, too, its values are
        taken back: the scene is what the loop has."""
        assert self._update is not None
        try:
            self._update.pending = self._simulation.engine.change(list(self._waiting.values()))
        except Exception as error:
            log.debug("parameters that were set cannot be given to the loop again", exc_info=error)
            none = ParameterUpdate({}, self._update.client, replaces=self._update)
            if self._first is self._update:
                self._first = None
            self.scene, self._waiting, self._update = self._taken, {}, none
            for effect in self._simulation.effects.values():
                effect.elastic = effect.elastic_in(self.scene)
            for observe in self.on_set:
                observe(none)

    def _described(self, field: LiveField) -> LiveParameter:
        low, high, value = field.live.low, field.live.high, _plain(field.value)
        if field.live.relative:
            start = self._start.get(field.key)
            low, high = (low * start, high * start) if isinstance(start, (int, float)) else (0.0, 0.0)
        if not isinstance(value, (int, float)) and any(not isinstance(v, (int, float)) for v in value):
            low = high = 0.0
        return LiveParameter(replace(field, value=value), toml(value), low, high)


def _plain(value: Any) -> Any:
    """Returns the value of a field as JSON has it."""
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if hasattr(value, "model_dump"):
        return value.model_dump(mode="json", by_alias=True, exclude_none=True)
    return [_plain(v) for v in value] if isinstance(value, (list, tuple)) else value


def toml(value: Any) -> str:
    """Returns a JSON value as TOML in one line, from which the same value is read."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{json.dumps(key)} = {toml(each)}" for key, each in value.items()) + " }"
    if isinstance(value, list):
        return "[" + ", ".join(map(toml, value)) + "]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    return json.dumps(value) if isinstance(value, bool) else repr(value)


def _at(table: Any, place: Sequence[str | int]) -> Any:
    for part in place:
        if isinstance(table, list) and isinstance(part, int):
            table = table[part]
        else:
            table = table.get(part) if isinstance(table, dict) else None
    return table


def _draft(scene: Scene, places: Sequence[Place], kinds: Iterable[str] = ()) -> dict[str, Any]:
    """Returns as JSON the tables that hold these places; others in the same list have their name alone.

    kinds: lists and tables to be there in any case
    """
    draft: dict[str, Any] = {}
    for kind in {*kinds, *(str(place[0]) for place in places)}:
        if kind == "effects":
            draft[kind] = {name: _plain(params) for name, params in scene.effects.items()}
            continue
        touched = {place[1] for place in places if place[0] == kind}
        listed: Sequence[SceneObject | Obstacle] = scene.objects if kind == "object" else scene.obstacles or []
        draft[kind] = [_plain(each) if index in touched else _named(each) for index, each in enumerate(listed)]
    return draft


def _with_regions(key: str, fields: Mapping[str, LiveField]) -> LiveField | None:
    """Returns the list of regions in which the constant of a key is, if there is just one such list."""
    beside = [f for f in fields.values() if _table(key) in (_table(f.key), _table(f.short))]
    found = [f for f in beside if isinstance(f.value, list) and isinstance(f.value[0], Selection)]
    return found[0] if len(found) == 1 else None


def _table(key: str) -> str:
    return key.rpartition(".")[0]


def _name(key: str) -> str:
    return key.rpartition(".")[2]


def _field(table: BaseModel, name: str) -> Any:
    return getattr(table, name) if name in type(table).model_fields else None


def _named(table: Any) -> dict[str, Any]:
    """Returns the name alone of a table in a list."""
    return {"name": table["name"] if isinstance(table, dict) else table.name}


def _differing(old: Any, new: Any, place: Place = ()) -> Iterator[Place]:
    """Yields the places of values that differ; lists of other lengths differ as a whole."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in old.keys() | new.keys():
            yield from _differing(old.get(key), new.get(key), (*place, key))
    elif isinstance(old, list) and isinstance(new, list) and len(old) == len(new):
        for k, (a, b) in enumerate(zip(old, new, strict=True)):
            yield from _differing(a, b, (*place, k))
    elif old != new:
        yield place
