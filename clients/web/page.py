# SPDX-License-Identifier: MIT
"""The page: joins what the server tells, and the tabs that show it."""

from __future__ import annotations

import contextlib
import io
import logging
import math
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import viser

from clients.log.frames import Mesh
from clients.web.feed import Feed, Link
from clients.web.hand import Grip, Hand, described_objects, grip
from clients.web.origin import own_pages_only
from clients.web.paint import Paint
from clients.web.panel.curves import History
from clients.web.panel.panels import Panels
from clients.web.solids import Obstacles, Springs
from clients.web.surfaces import MOST_VERTICES, Surfaces
from clients.web.tab import Tab
from clients.web.view import View, home, up_of
from protocol import messages_pb2 as pb
from protocol.network.web_address import exposed

PERIOD = 1 / 120  # s between two looks for new frames, which come 30 times a second
PAINT_PERIOD = 0.2  # s between two colourings
PAINT_SHARE = 0.2  # of the time that colouring may take
CURVE_PERIOD = 0.25  # s
PANEL_PERIOD = 0.25  # s

log = logging.getLogger(__name__)


class Page:
    """Serves the page at host:port until `close`. Its loop is `run`; a failure in it is told, and the loop goes on."""

    def __init__(self, server: str, connect: Sequence[str] | None, host: str, port: int) -> None:
        self.feed = Feed(server, connect)
        self.surfaces: Surfaces | None = None
        self.grips: dict[str, Grip] = {}
        self.home: View | None = None
        self._up: Any = None
        self._history = History(())
        self._paints: dict[str, Paint] = {}
        self._obstacles: Obstacles | None = None
        self._due: dict[str, float] = {}
        self._tabs: dict[int, Tab] = {}
        self._new: list[viser.ClientHandle] = []  # tabs that are to be built in the loop
        self._lock = threading.Lock()
        with _quiet(), own_pages_only(loopback=not exposed(host, port)):
            self._viser = viser.ViserServer(host=host, port=port, label="Warpfactor", verbose=False)
        self._viser.request_share_url = _no_share_url  # type: ignore[method-assign]
        self._viser.gui.configure_theme(show_logo=False, show_share_button=False)
        self._viser.gui.main_panel.dock_right()
        self._light()
        self._panels = Panels(self._viser.gui, self.tab)
        self._springs = Springs(self._viser.scene)
        self._viser.on_client_connect(self._connected)
        self._viser.on_client_disconnect(self._disconnected)

    def _light(self) -> None:
        """Lights without shadows, and less bright than viser's, under which colours are pale."""
        scene = self._viser.scene
        scene.configure_default_lights(enabled=False)
        scene.add_light_ambient("/lights/ambient", intensity=0.7)
        scene.add_light_directional("/lights/front", intensity=1.3, position=(1.0, 2.0, 3.0))
        scene.add_light_directional("/lights/back", intensity=0.6, position=(-2.0, 1.0, -2.0))

    @property
    def port(self) -> int:
        """The port that it has."""
        return int(self._viser.get_port())

    def tab(self, number: int) -> Tab | None:
        """Returns a tab by viser's number of its connection."""
        with self._lock:
            return self._tabs.get(number)

    def asked(self) -> None:
        """Has the status asked for now, after a command."""
        link = self.feed.link
        if link is not None:
            link.ask_now()

    def run(self) -> None:
        """Serves until an exception such as KeyboardInterrupt comes."""
        while True:
            try:
                self._round()
            except Exception:
                log.exception("the page goes on after this")
                time.sleep(1.0)
            time.sleep(PERIOD)

    def close(self) -> None:
        with self._lock:
            tabs = list(self._tabs.values())
        for tab in tabs:
            tab.close()
        self.feed.close()
        with _quiet():
            self._viser.stop()

    # --- one round --------------------------------------------------------------------------------------------------

    def _round(self) -> None:
        if self.feed.check():
            self._begin(self.feed.link)
        self._build_tabs()
        link = self.feed.link
        if link is not None:
            for tab in self._all():
                tab.keep_connected()
        if link is None:
            if self._is_due("panels", PANEL_PERIOD):
                self._panels.lost(self.feed.error)
            return
        self._take_steps(link.steps())
        if self._obstacles is not None:
            self._obstacles.move(link.poses())
        assert self.surfaces is not None
        self._take_meshes(link)
        moved = [frame for frame in link.frames() if self.surfaces.move(frame.object, frame.x)]
        modes = {tab: tab.mode.value for tab in self._all()}  # a person may change them at any time: read once
        self._colour(bool(moved), set(modes.values()))
        self._show(bool(moved), modes)
        if self._is_due("curves", CURVE_PERIOD):
            self._panels.draw()
        if self._is_due("panels", PANEL_PERIOD) and link.status.scene:
            self._panels.show(link.status, link.parameters)

    def _begin(self, link: Link | None) -> None:
        """Takes up another scene, or none."""
        for tab in self._all():
            tab.clear()
            tab.connect()
        if self._obstacles is not None:
            self._obstacles.remove()
            self._obstacles = None
        self._paints.clear()
        self.surfaces = None
        if link is None:
            self._panels.lost(self.feed.error)
            return
        try:
            self._take_up(link)
        except Exception:
            self.surfaces = None
            self.feed.drop("the scene of the server cannot be shown")
            raise

    def _take_up(self, link: Link) -> None:
        """Takes up the scene of a link; `surfaces` is set last, as all else needs the rest."""
        surfaces = Surfaces(link.meshes)
        if surfaces.full > MOST_VERTICES:
            log.warning(
                "%d vertices on the surfaces: %d are shown, so that a browser keeps pace",
                surfaces.full, len(surfaces.points),
            )  # fmt: skip
        low, high = surfaces.box()
        up = up_of(link.scene.resolved)
        history = History(link.meshes)
        self._grip(link)
        self._obstacles = Obstacles(self._viser.scene, link.obstacles, low, high)
        self._panels.begin(history, link.scene.dt)
        self._history, self._up, self.home = history, up, home(low, high, up)
        self._viser.scene.set_up_direction(up)
        self._viser.initial_camera.position = self.home.position
        self._viser.initial_camera.look_at = self.home.target
        self.surfaces = surfaces
        for tab in self._all():
            tab.look_home()

    def _grip(self, link: Link) -> None:
        described = described_objects(link.scene.resolved)
        self.grips = {name: grip(mesh, described.get(name, {})) for name, mesh in link.meshes.items()}

    def _take_meshes(self, link: Link) -> None:
        """Takes up moduli that were set, and surfaces that were cut: colours and springs are made anew."""
        assert self.surfaces is not None
        new = link.take_meshes()
        if new == "cut":
            old, self.surfaces = self.surfaces, self.surfaces.cut(link.meshes)
            for hand in self._hands():
                if hand.vertex < len(old.points) and len(self.surfaces.points):
                    hand.vertex = self.surfaces.nearest(old.points[hand.vertex])[1]
        elif new:
            self.surfaces.take_moduli(link.meshes)
        if new:
            self._paints.clear()
            self._grip(link)

    def _take_steps(self, steps: Sequence[pb.ObjectStep]) -> None:
        self._history.add(steps)
        forces = {r.grab: r.force for step in steps for r in step.reactions if r.HasField("grab")}
        for hand in self._hands():
            if hand.id in forces:
                f = forces[hand.id]
                hand.force = math.hypot(f.x, f.y, f.z)

    def _colour(self, moved: bool, wanted: set[str]) -> None:
        """Colours the surface in each way that a tab wants, a few times a second."""
        assert self.surfaces is not None
        for mode in set(self._paints) - wanted:
            del self._paints[mode]
        for mode in wanted - set(self._paints):
            self._paints[mode] = Paint(self.surfaces, mode)
        if moved and self._is_due("paint", PAINT_PERIOD):
            began = time.monotonic()
            for paint in self._paints.values():
                paint.update()
            took = time.monotonic() - began
            self._due["paint"] = time.monotonic() + max(PAINT_PERIOD, took / PAINT_SHARE)

    def _show(self, moved: bool, modes: Mapping[Tab, str]) -> None:
        assert self.surfaces is not None
        for tab, mode in modes.items():
            tab.show(self.surfaces, self._paints[mode], moved)
        self._springs.update(self._hands(), self.surfaces)
        for tab in modes:
            for hand in [h for h in tab.hands.values() if h.over]:
                tab.hands.pop(hand.number, None)

    def _is_due(self, what: str, period: float) -> bool:
        now = time.monotonic()
        if now < self._due.get(what, 0.0):
            return False
        self._due[what] = now + period
        return True

    # --- tabs -------------------------------------------------------------------------------------------------------

    def _all(self) -> list[Tab]:
        with self._lock:
            return list(self._tabs.values())

    def _hands(self) -> list[Hand]:
        return [hand for tab in self._all() for hand in list(tab.hands.values())]

    async def _connected(self, viewer: viser.ClientHandle) -> None:
        with self._lock:
            self._new.append(viewer)

    async def _disconnected(self, viewer: viser.ClientHandle) -> None:
        with self._lock:
            self._new = [v for v in self._new if v.client_id != viewer.client_id]
            tab = self._tabs.pop(viewer.client_id, None)
        if tab is not None:
            tab.close()

    def _build_tabs(self) -> None:
        with self._lock:
            new, self._new = self._new, []
        for viewer in new:
            tab = Tab(self, viewer, self._usual_mode())
            with self._lock:
                self._tabs[viewer.client_id] = tab
            if viewer.client_id not in self._viser.get_clients():  # it went while its tab was built
                with self._lock:
                    self._tabs.pop(viewer.client_id, None)
                tab.close()

    def _usual_mode(self) -> str:
        """Materials where an object has several, else displacements."""
        link = self.feed.link
        return "material" if link is not None and any(map(_mixed, link.meshes.values())) else "displacement"


def _mixed(mesh: Mesh) -> bool:
    return len(mesh.young) > 0 and float(mesh.young.max()) > 1.01 * float(mesh.young.min())


def _no_share_url(verbose: bool = True) -> None:
    """Opens no relay on the internet, whoever asks for one."""


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without viser's words about itself."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
