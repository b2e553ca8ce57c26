# SPDX-License-Identifier: MIT
"""What stands beside the bodies and is the same in all tabs: state, buttons, parameters, curves, tables."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from clients.web.panel.curves import Curves, History
from clients.web.panel.sliders import Sliders
from clients.web.panel.tables import summary, tables, warning
from protocol import messages_pb2 as pb

if TYPE_CHECKING:
    import viser

    from clients.web.tab import Tab

WIDTH = 330  # pixels of the panel with curves
NONE = "-"


class Panels:
    """tab: returns the tab of a number, whose client sends the commands of its buttons; None: it is gone."""

    def __init__(self, gui: viser.GuiApi, tab: Callable[[int], Tab | None]) -> None:
        self._gui, self._tab = gui, tab
        self._paused: bool | None = None
        self._curves: Curves | None = None
        self._state = gui.add_html(warning("no server yet"), order=0)
        with gui.add_folder("Simulation", order=2):
            self._pause = gui.add_button("Pause")
            step, reset = gui.add_button("Single step"), gui.add_button("Reset")
        self._on(self._pause, lambda client: client.resume() if self._paused else client.pause())
        self._on(step, lambda client: client.step())
        self._on(reset, lambda client: client.reset())
        self._folder = gui.add_folder("Parameters", order=3)
        self._sliders = Sliders(gui, self._folder, self._change)
        self._build_side(gui)

    def _build_side(self, gui: viser.GuiApi) -> None:
        panel = gui.add_panel()
        with panel.add_tab("Curves") as self._side:
            self._tables = gui.add_html("", order=100)
            self._workers = gui.add_folder("Local workers", order=101, visible=False)
            with self._workers:
                self._names = gui.add_dropdown("worker", (NONE,))
                kill, add = gui.add_button("Kill it"), gui.add_button("Add one")
        self._on(kill, lambda client: client.kill_worker(self._names.value))
        self._on(add, lambda client: client.add_worker())
        panel.dock_left()
        panel.set_width(WIDTH)

    def begin(self, history: History, dt: float) -> None:
        """Makes the curves of a scene in place of those before; the same ones go on for a server started again."""
        if self._curves is not None and self._curves.fits(history, dt):
            self._curves.history = history
            return
        if self._curves is not None:
            self._curves.remove()
        with self._side:
            self._curves = Curves(self._gui, history, dt)

    def lost(self, why: str) -> None:
        """Says that there is no server."""
        self._state.content = warning(f"{why}; trying again")

    def show(self, status: pb.Status, parameters: list[pb.LiveParameter]) -> None:
        """Shows what the server said last."""
        self._state.content = summary(status)
        self._tables.content = tables(status)
        paused = status.state == "paused"
        if paused != self._paused:
            self._paused = paused
            self._pause.label = "Resume" if paused else "Pause"
        names = tuple(worker.worker for worker in status.local_workers)
        self._workers.visible = bool(names)
        if names and names != self._names.options:
            self._names.options = names
        self._folder.visible = bool(parameters)
        self._sliders.update(parameters)

    def draw(self) -> None:
        """Draws the curves as they are now."""
        if self._curves is not None:
            self._curves.update()

    def _change(self, number: int, key: str, value: Any) -> None:
        tab = self._tab(number)
        if tab is not None:
            tab.set(key, value)

    def _on(self, button: Any, what: Callable[[Any], object]) -> None:
        @button.on_click
        async def _(event: Any) -> None:
            tab = self._tab(event.client_id)
            if tab is not None:
                tab.ask(what)
