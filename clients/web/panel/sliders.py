# SPDX-License-Identifier: MIT
"""Sliders of the live parameters, the same in all tabs: whoever changes a value, everybody sees it."""

from __future__ import annotations

import math
import time
import tomllib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from clients.web.panel.regions import Regions, has_regions
from protocol import messages_pb2 as pb

if TYPE_CHECKING:
    import viser

HANDS_ON = 1.5  # s after a change here in which the server's value does not move the slider
STEPS = 200  # of a slider
FACTORS = 0.1, 10.0  # ends of the slider of a parameter with a value for each region
OPEN = 4  # folders that are open at first, if there are no more


def value_of(text: str) -> Any:
    """Returns the value of a parameter's TOML, None if it cannot be read."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return None


def named(key: str) -> tuple[str, str]:
    """Returns what a parameter belongs to, and its name there: object.o.effects.e.young as o and e.young."""
    words = key.split(".")
    if words[0] == "object" and len(words) > 2:
        return words[1], ".".join(words[3:] if words[2] == "effects" else words[2:])
    if words[0] == "obstacle" and len(words) > 2:
        return words[1], ".".join(words[2:])
    return "scene", ".".join(words[1:] if words[0] == "effects" else words)


def kind(parameter: pb.LiveParameter) -> str:
    """Returns how a parameter is shown: number, yes, vector, regions, or table, which has no slider."""
    value = value_of(parameter.now.value)
    if isinstance(value, bool):
        return "yes"
    if isinstance(value, int | float):
        return "number"
    if isinstance(value, list) and len(value) == 3 and all(isinstance(v, int | float) for v in value):
        return "vector"
    return "regions" if parameter.logarithmic and has_regions(parameter.now.key, value) else "table"


class Slider:
    """One parameter: a slider for a number, or for a factor of those of all regions, three numbers for a vector, a box
    for yes and no.
    """

    def __init__(self, gui: viser.GuiApi, parameter: pb.LiveParameter, change: Callable[[int, str, Any], None]) -> None:
        self.key, self._unit = parameter.now.key, parameter.unit
        self._log, self._low, self._high = parameter.logarithmic, parameter.low, parameter.high
        self._kind = kind(parameter)
        self._regions = Regions(self.key, value_of(parameter.now.value)) if self._kind == "regions" else None
        if self._regions is not None:
            self._unit, (self._low, self._high) = "-", FACTORS
        self._value = self._read(parameter)
        self._touched = 0.0
        self._handle: Any = self._build(gui, parameter.about)
        if self._handle is None:
            return

        @self._handle.on_update
        async def _(event: Any) -> None:
            if event.client_id is None:  # set by this program
                return
            self._touched = time.monotonic()
            self._value = self._meant(self._handle.value)
            self._handle.label = self._label()
            regions = self._regions
            change(event.client_id, self.key, self._value if regions is None else regions.times(self._value))

    def show(self, parameter: pb.LiveParameter) -> None:
        """Moves it to the server's value, unless somebody has a hand on it."""
        value = self._read(parameter)
        if self._handle is None or value == self._value or time.monotonic() < self._touched + HANDS_ON:
            return
        self._value = value
        self._handle.label = self._label()
        self._handle.value = self._shown(value)

    def _read(self, parameter: pb.LiveParameter) -> Any:
        """Returns the value, of regions their factor."""
        value = value_of(parameter.now.value)
        return value if self._regions is None else self._regions.factor(value)

    def _build(self, gui: viser.GuiApi, about: str) -> Any:
        value, label, hint = self._value, self._label(), about or None
        if self._kind == "yes":
            return gui.add_checkbox(label, value, hint=hint)
        if self._kind in ("number", "regions"):
            low, high = self._bounds()
            return gui.add_slider(label, low, high, (high - low) / STEPS, self._shown(value), hint=hint)
        if self._kind == "vector":
            return gui.add_vector3(label, (float(value[0]), float(value[1]), float(value[2])), hint=hint)
        return None  # a table, say: set by sim-client set

    def _bounds(self) -> tuple[float, float]:
        """Returns the ends of the slider, its present value among them."""
        low, high, now = self._low, self._high, float(self._value)
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            low, high = (now / 10, now * 10) if now > 0 else (now - 1, now + 1)
        low, high = min(low, now), max(high, now)
        self._log = self._log and low > 0
        if not self._log:
            return low, high
        return math.floor(100 * math.log10(low)) / 100, math.ceil(100 * math.log10(high)) / 100

    def _shown(self, value: Any) -> Any:
        if isinstance(value, list):
            return tuple(float(v) for v in value)
        if isinstance(value, bool):
            return value
        place = round(math.log10(value), 2) if self._log and value > 0 else float(value)
        handle = getattr(self, "_handle", None)
        return place if handle is None else min(max(place, handle.min), handle.max)

    def _meant(self, place: Any) -> Any:
        if isinstance(place, tuple):
            return list(place)
        return float(f"{10**place:.4g}") if self._log and not isinstance(place, bool) else place

    def _label(self) -> str:
        name = named(self.key)[1]
        if self._regions is not None:
            what = "stiffness" if name.endswith("young") else "all regions"
            return f"{name}: {what} x {self._value:.4g}"
        number = isinstance(self._value, int | float) and not isinstance(self._value, bool)
        value = f"{self._value:.4g} " if number else ""
        shown = f"{value}{self._unit if self._unit != '-' else ''}".strip()
        return f"{name}: {shown}" if shown else name


class Sliders:
    """All of them in one container. change: called in the event loop with the tab's number, the key and the value."""

    def __init__(self, gui: viser.GuiApi, container: Any, change: Callable[[int, str, Any], None]) -> None:
        self._gui, self._container, self._change = gui, container, change
        self._sliders: dict[str, Slider] = {}
        self._described: list[pb.LiveParameter] = []  # all but the values of those that have sliders
        self._folders: list[Any] = []

    def update(self, parameters: Sequence[pb.LiveParameter]) -> None:
        """Shows the parameters as the server has them."""
        described = [_described(p) for p in parameters]
        if described != self._described:
            self._described = described
            self._build(parameters)
        for parameter in parameters:
            self._sliders[parameter.now.key].show(parameter)

    def _build(self, parameters: Sequence[pb.LiveParameter]) -> None:
        """Makes them anew, those of an object in a folder of its own."""
        for folder in self._folders:
            folder.remove()
        self._folders, self._sliders = [], {}
        owners = list(dict.fromkeys(named(p.now.key)[0] for p in parameters))
        for owner in owners:
            with self._container:
                folder = self._gui.add_folder(owner, expand_by_default=len(owners) <= OPEN)
            self._folders.append(folder)
            with folder:
                for p in parameters:
                    if named(p.now.key)[0] == owner:
                        self._sliders[p.now.key] = Slider(self._gui, p, self._change)


def _described(parameter: pb.LiveParameter) -> pb.LiveParameter:
    """Returns a parameter with the kind of its value in place of the value."""
    found = pb.LiveParameter()
    found.CopyFrom(parameter)
    found.now.value = kind(parameter)
    return found
