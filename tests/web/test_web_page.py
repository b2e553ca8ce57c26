# SPDX-License-Identifier: MIT
"""The page of sim-client web in a real browser: one server, one page and one Chromium for all tests."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from clients.client import Client
from clients.web.view import home, up_of
from tests.ports import free_port
from tests.support.browser import browser, choose_colour, field, missing, on_screen, open_page, pixels
from tests.system.server_process import Stage, until

# A browser that draws in software takes its time on a full machine.
pytestmark = [
    pytest.mark.system,
    pytest.mark.timeout(300),
    pytest.mark.skipif(bool(missing()), reason=missing() or "-"),
]

SCENE = """
dt = 0.02
[[object]]
name = "beam"
mesh = { bar = [3, 3, 9], size = [1, 1, 4] }
density = 100
[object.effects]
corotational = { young = 1e5, poisson = 0.3 }
rayleigh = { mass = 5 }
fixed = { where = "Z < 0.01" }
touch = true
"""
FRONT, BACK = (1.0, 1 / 3, 32 / 9), (1.0, 1 / 3, 16 / 9)  # rest positions of nodes on the side that the camera sees [m]


class World:
    """A server, its page, a browser, and a client that sees what comes of it."""

    def __init__(self, stage: Stage, client: Client, chromium: Any) -> None:
        self.client, self.chromium = client, chromium
        port = free_port()
        self.page = stage.start("clients", "web", "--connect", stage.endpoint, "--port", str(port))
        self.address = f"http://127.0.0.1:{port}"
        self.mesh = client.meshes()["beam"]
        self._states, self._steps = client.states(), client.steps()
        self._x, self._grabs = self.mesh.rest, set[int]()
        self.view = home(self.mesh.rest.min(axis=0), self.mesh.rest.max(axis=0), up_of(client.scene().resolved))

    def tab(self) -> Any:
        return open_page(self.chromium, self.address)

    def node(self, rest: tuple[float, float, float]) -> int:
        return int(np.linalg.norm(self.mesh.rest - rest, axis=1).argmin())

    def moved(self, rest: tuple[float, float, float]) -> float:
        """How far a node is from where it was at rest now [m]."""
        for frame in self._states.newest():
            self._x = frame.x
        node = self.node(rest)
        return float(np.linalg.norm(self._x[node] - self.mesh.rest[node]))

    def grabs(self) -> set[int]:
        """The grabs of the newest step."""
        for step in self._steps.new():
            self._grabs = {r.grab for r in step.reactions if r.HasField("grab")}
        return self._grabs

    def drag(self, tab: Any, rest: tuple[float, float, float], by: tuple[int, int] = (-60, -60)) -> None:
        """Presses the pointer on a node and moves it; it is not let go."""
        self.moved(rest)
        x, y = on_screen(tab, self.view, self._x[self.node(rest)])
        tab.mouse.move(x, y)
        tab.mouse.down()
        tab.mouse.move(x + by[0], y + by[1], steps=6)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    folder = tmp_path_factory.mktemp("web")
    scene = folder / "beam.toml"
    scene.write_text(SCENE)
    stage = Stage(folder)
    try:
        stage.server(scene)
        with stage.client() as client, browser() as chromium:
            found = World(stage, client, chromium)
            until(lambda: "the page is at" in found.page.output(), "a page")
            yield found
    finally:
        stage.close()


@pytest.fixture(scope="module")
def tab(world: World) -> Any:
    return world.tab()


def test_it_shows_the_body_and_what_the_server_does(world: World, tab: Any) -> None:
    middle, beside = (on_screen(tab, world.view, (1.0, y, 2.0)) for y in (0.5, 2.5))

    def coloured(at: tuple[float, float]) -> int:
        """Pixels that have a colour, of 1600."""
        shown = pixels(tab, at)
        return int(((np.ptp(shown[..., :3], axis=2) > 40) & (shown[..., 3] > 200)).sum())

    until(lambda: coloured(middle) > 1000, "a body in the middle of the picture")
    assert coloured(beside) == 0
    choose_colour(tab, "von Mises stress")
    tab.get_by_text("von Mises stress: 0 (violet)").wait_for()
    tab.get_by_text("iterations of a step").wait_for()
    tab.get_by_role("cell", name="at rest").wait_for()


def test_a_drag_moves_the_body_and_letting_go_releases_it(world: World, tab: Any) -> None:
    assert world.moved(FRONT) < 0.01
    world.drag(tab, FRONT)
    until(lambda: world.moved(FRONT) > 0.2 and len(world.grabs()) == 1, "a body that follows the pointer")
    tab.mouse.up()
    until(lambda: not world.grabs(), "the release")
    until(lambda: world.moved(FRONT) < 0.05, "a body that goes back")


def test_a_drag_with_shift_pushes(world: World, tab: Any) -> None:
    tab.keyboard.down("Shift")
    world.drag(tab, FRONT)
    tab.mouse.up()
    tab.keyboard.up("Shift")
    until(lambda: world.moved(FRONT) > 0.02, "a push")
    assert not world.grabs()
    until(lambda: world.moved(FRONT) < 0.01, "a body that goes back")


def test_a_slider_changes_the_stiffness_and_follows_others(world: World, tab: Any) -> None:
    value = field(tab, "corotational.young")
    value.fill("4.5")
    value.press("Enter")
    until(lambda: _young(world.client) == pytest.approx(10**4.5, rel=1e-3), "the value of the slider")
    world.client.set("beam.corotational.young", 2e5)
    tab.get_by_text("corotational.young: 2e+05 Pa").wait_for()
    assert _young(world.client) == 2e5  # the slider that was moved sends nothing back


def test_buttons_pause_and_resume(world: World, tab: Any) -> None:
    tab.get_by_role("button", name="Pause").dispatch_event("click")
    until(lambda: world.client.status(fresh=True).state == "paused", "a pause")
    tab.get_by_role("button", name="Resume").dispatch_event("click")
    until(lambda: world.client.status(fresh=True).state == "running", "that it goes on")


def test_tabs_have_grabs_of_their_own_and_one_that_closes_lets_go(world: World, tab: Any) -> None:
    other = world.tab()
    world.drag(tab, FRONT, (-40, -40))
    until(lambda: len(world.grabs()) == 1, "the grab of one tab")
    (first,) = world.grabs()
    world.drag(other, BACK, (30, -30))
    until(lambda: len(world.grabs()) == 2, "grabs of both")
    other.close()
    until(lambda: world.grabs() == {first}, "the release by the tab that closed")
    step = world.client.status(fresh=True).step
    until(lambda: world.client.status(fresh=True).step > step, "that the server goes on")
    tab.mouse.up()
    until(lambda: not world.grabs(), "the release by the other")


def test_a_page_that_is_killed_lets_go(world: World, tab: Any) -> None:
    """The last test: it leaves no page."""
    world.drag(tab, FRONT)
    until(lambda: len(world.grabs()) == 1, "a grab")
    world.page.kill()
    until(lambda: not world.grabs(), "the release of what a dead page held")


def _young(client: Client) -> float:
    return next(float(p.now.value) for p in client.parameters() if p.now.key.endswith("corotational.young"))
