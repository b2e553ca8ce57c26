# SPDX-License-Identifier: MIT
"""One tab of a browser: a client of the server with grabs of its own, what it shows, and how.

A tab that closes, or whose connection breaks, closes its client, and the server releases what that held.
"""

from __future__ import annotations

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np

from clients.client import Client
from clients.errors import BadInput, ClientError
from clients.web.hand import Hand, push, swept
from clients.web.paint import MODES, Paint
from clients.web.surfaces import Surfaces

if TYPE_CHECKING:
    import viser

    from clients.web.page import Page

log = logging.getLogger(__name__)

RETRY_PERIOD = 1.0  # s between two attempts of a tab to connect
TOGETHER = 0.02  # s from the first change of a slider to the command that has all that came meanwhile
NOTHING, FLAT = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint32)  # what a band without triangles shows
RADIUS = 8.0  # % of the object's size: default of the patch that a grab takes


class Tab:
    """What belongs to one tab. viewer: viser's handle of it."""

    def __init__(self, page: Page, viewer: viser.ClientHandle, mode: str) -> None:
        self.page, self.viewer = page, viewer
        self.client: Client | None = None
        self.hands: dict[int, Hand] = {}  # by number; also such as are over, until the page has taken their lines away
        self.closed = False
        self._hand: Hand | None = None
        self._from: tuple[str, int] | None = None  # object and vertex of a push
        self._nodes: list[Any] = []
        self._shown: tuple[Paint | None, int] = (None, 0)
        self._pending: dict[str, Any] = {}
        self._connecting, self._due, self._why = False, 0.0, ""  # when to try again; why there is no client
        self._lock = threading.Lock()
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix=f"tab-{viewer.client_id}")
        self._build(mode)
        self.connect()

    # --- the server -------------------------------------------------------------------------------------------------

    def connect(self) -> None:
        """Makes a client of the server that the page has now, in place of an older one."""
        self.hands_off()
        with self._lock:
            self._pending = {}
        self._connecting = True
        self._submit(self._reconnect)

    def keep_connected(self) -> None:
        """Tries again if there is no client of the server that the page has. Does not wait."""
        if self.client is None and not self._connecting and time.monotonic() >= self._due:
            self.connect()

    def _reconnect(self) -> None:
        try:
            self._disconnect()
            link = self.page.feed.link
            if link is not None and not self.closed:
                self.client = Client(link.client.name, self.page.feed.connect)
        except (ClientError, BadInput) as error:
            self._why = str(error)
        finally:
            self._due = time.monotonic() + RETRY_PERIOD
            self._connecting = False

    def _disconnect(self) -> None:
        client, self.client = self.client, None
        if client is not None:
            client.close()

    def ask(self, what: Callable[[Any], object]) -> None:
        """Has a command of this tab sent by a thread of its own; the person is told why it was refused."""
        self._submit(lambda: self._do(what))

    def _do(self, what: Callable[[Any], object]) -> None:
        try:
            if self.client is None:
                raise ClientError(self._unconnected())
            what(self.client)
            self.page.asked()
        except (BadInput, ClientError) as error:
            self.tell(str(error))

    def _unconnected(self) -> str:
        return f"this tab has no connection to the server, and tries again{f': {self._why}' if self._why else ''}"

    def set(self, key: str, value: Any) -> None:
        """Sets a live parameter; of several changes that come while one is on its way the newest counts."""
        with self._lock:
            first = not self._pending
            self._pending[key] = value
        if first:
            self._submit(self._set_pending)

    def _set_pending(self) -> None:
        time.sleep(TOGETHER)
        with self._lock:
            values, self._pending = self._pending, {}
        if values:
            self._do(lambda client: client.set(values))

    def tell(self, text: str) -> None:
        """Shows a message in this tab."""
        if not self.closed:
            self.viewer.add_notification("Not done", text, color="orange", auto_close_seconds=6.0)

    def close(self) -> None:
        """Releases everything. Does not wait."""
        self.closed = True
        self.hands_off()
        self._submit(self._disconnect)
        self._worker.shutdown(wait=False)

    def _submit(self, work: Callable[[], None]) -> None:
        def guarded() -> None:
            try:
                work()
            except Exception:
                log.exception("a command of a tab failed")

        with contextlib.suppress(RuntimeError):  # the tab is closed
            self._worker.submit(guarded)

    # --- what it shows ----------------------------------------------------------------------------------------------

    def _build(self, mode: str) -> None:
        gui = self.viewer.gui
        with gui.add_folder("This tab", order=1):
            self.mode = gui.add_dropdown("colour", MODES, initial_value=mode)
            self._legend = gui.add_markdown("")
            self._radius = gui.add_slider(
                "patch", 0.0, 40.0, 1.0, RADIUS, hint="radius of what a grab or push takes, % of the object's size"
            )
            self._strength = gui.add_slider(
                "strength",
                0.1,
                10.0,
                0.1,
                1.0,
                hint="stiffness of the springs of grabs, and of pushes, over the default",
            )
            home = gui.add_button("Camera home")

        @home.on_click
        async def _(_: object) -> None:
            self.look_home()

    def look_home(self) -> None:
        """Puts the camera where it sees everything."""
        view = self.page.home
        if view is not None:
            self.viewer.camera.up_direction = view.up
            self.viewer.camera.position = view.position
            self.viewer.camera.look_at = view.target

    def show(self, surfaces: Surfaces, paint: Paint, moved: bool) -> None:
        """Sends the positions if they have moved, and the bands if they have changed."""
        new = self._shown != (paint, paint.version)
        if self.closed or not (moved or new):
            return
        with self.viewer.atomic():
            self._have(len(paint.bands))
            for node, band in zip(self._nodes, paint.bands, strict=False):
                node.vertices = surfaces.points[band.vertices] if len(band.vertices) else NOTHING
                if new:
                    node.faces = band.triangles if len(band.vertices) else FLAT
                    node.color, node.flat_shading, node.visible = band.color, not paint.smooth, True
            if new:
                for node in self._nodes[len(paint.bands) :]:
                    node.visible = False
                self._legend.content = paint.legend
        self.viewer.flush()  # viser would wait for more, up to a 60th of a second
        self._shown = (paint, paint.version)

    def clear(self) -> None:
        """Takes the bodies away, as the scene is another one or there is none."""
        for node in self._nodes:
            node.visible = False
        self._shown = (None, 0)

    def _have(self, count: int) -> None:
        """Has at least so many meshes; they stay, since a drag ends when its node is removed or hidden."""
        while len(self._nodes) < count:
            node = self.viewer.scene.add_mesh_simple(
                f"/bodies/{len(self._nodes)}", NOTHING, FLAT, side="double",
                cast_shadow=False, receive_shadow=False, visible=False,
            )  # fmt: skip
            node.on_drag("left")(self._grab)
            node.on_drag("left", modifier="shift")(self._push)
            node.on_drag("left", modifier="cmd/ctrl")(self._cut)
            self._nodes.append(node)

    # --- pointer ----------------------------------------------------------------------------------------------------

    async def _grab(self, event: viser.SceneNodeDragEvent) -> None:
        if event.phase == "start":
            self._take(event.start_position, event.end_position)
        elif self._hand is not None and event.phase == "update":
            self._hand.move(event.end_position)
        elif self._hand is not None:
            self._hand.release()
            self._hand = None

    def _take(self, point: Sequence[float], target: Sequence[float]) -> None:
        self.hands_off()
        surfaces, client = self.page.surfaces, self.client
        if surfaces is None or client is None or self.closed:
            self.tell(self._unconnected())
            return
        name, vertex = surfaces.nearest(np.asarray(point))
        grip = self.page.grips.get(name)
        if grip is None:
            return
        stiffness = grip.stiffness * self._strength.value
        self._hand = Hand(
            client, name, vertex, surfaces.points[vertex], target, self._radius.value / 100 * grip.size, stiffness,
            min(stiffness * grip.size, grip.limit), lambda why: self.tell(f"{name}: {why}"),
        )  # fmt: skip
        self.hands[self._hand.number] = self._hand
        if self.page.surfaces is not surfaces:  # another scene came meanwhile
            self.hands_off()

    async def _push(self, event: viser.SceneNodeDragEvent) -> None:
        surfaces, client = self.page.surfaces, self.client
        if surfaces is None or client is None:
            if event.phase == "start":
                self.tell(self._unconnected())
            return
        if event.phase == "start":
            self._from = surfaces.nearest(np.asarray(event.start_position))
        elif event.phase == "end" and self._from is not None:
            (name, vertex), self._from = self._from, None
            grip = self.page.grips.get(name)
            if grip is None or vertex >= len(surfaces.points):
                return
            force = grip.stiffness * self._strength.value * np.subtract(event.end_position, event.start_position)
            size = float(np.linalg.norm(force))
            force *= min(1.0, grip.limit / size) if size else 0.0
            radius = self._radius.value / 100 * grip.size
            push(client, name, surfaces.points[vertex], force, radius, lambda why: self.tell(f"{name}: {why}"))

    async def _cut(self, event: viser.SceneNodeDragEvent) -> None:
        surfaces = self.page.surfaces
        if event.phase != "end" or surfaces is None or not len(surfaces.points):
            return
        name, _ = surfaces.nearest(np.asarray(event.start_position))
        grip = self.page.grips.get(name)
        if grip is not None:
            eye = np.asarray(self.viewer.camera.position)
            blade = swept(event.start_position, event.end_position, eye, grip.size)
            self.ask(lambda client: client.cut(name, blade=blade))

    def hands_off(self) -> None:
        """Lets go of everything."""
        for hand in list(self.hands.values()):
            hand.release()
        self._hand = None
