# SPDX-License-Identifier: MIT
"""The page without a browser: surfaces, colours, curves, grabs, addresses, a server that goes and comes."""

import asyncio
import json
import os
import threading
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from clients.errors import ClientError
from clients.log.frames import Frame, Mesh, Skin
from clients.web import feed as feed_module
from clients.web.decimate import decimated
from clients.web.feed import Feed, Link
from clients.web.hand import Hand, described_objects, grip, swept
from clients.web.paint import BANDS, Paint, split
from clients.web.panel.curves import POINTS, History
from clients.web.panel.sliders import Slider, Sliders, named, value_of
from clients.web.panel.tables import tables
from clients.web.surfaces import Surfaces
from clients.web.tab import Tab
from clients.web.view import home, up_of
from protocol import messages_pb2 as pb
from protocol.network.web_address import exposed, hindrance, shown, web_address
from protocol.refused import Refused
from sim_server.service.web_page import FIRST_PAUSE, LASTED, MOST_RESTARTS, WebPage
from tests.clients.fake_server import FakeServer
from tests.ports import free_port
from tests.system.server_process import Stage, beam, until


def grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """A sheet of side x side points and its triangles, seen from +z."""
    x, y = np.meshgrid(np.arange(side, dtype=float), np.arange(side, dtype=float), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.zeros(side * side)], axis=1)
    a = (np.arange(side - 1)[:, None] * side + np.arange(side - 1)).ravel()
    return points, np.concatenate([np.stack([a, a + side, a + 1], 1), np.stack([a + 1, a + side, a + side + 1], 1)])


def tet(object: str = "a", young: float = 1e5, shift: float = 0.0) -> Mesh:
    """One tetrahedron with edges of 1 m along the axes."""
    rest = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float) + shift
    sides = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    one = np.float32
    return Mesh(
        object=object, epoch=1, rest=rest, tets=np.array([[0, 1, 2, 3]], np.int32), triangles=sides,
        fixed=np.zeros(0, np.int32), young=np.array([young], one), poisson=np.array([0.3], one),
    )  # fmt: skip


def test_a_coarser_surface_has_few_vertices_of_the_finer_one_and_covers_it() -> None:
    points, triangles = grid(60)
    kept, coarse = decimated(points, triangles, 400)
    assert 200 < len(kept) <= 400 and len(set(kept)) == len(kept)
    assert coarse.max() < len(kept)
    corners = points[kept][coarse]
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    assert (areas > -1e-9).all()  # none is turned over
    assert areas.sum() == pytest.approx(59**2, rel=0.15)


def test_both_sides_of_a_thin_sheet_stay_apart() -> None:
    points, triangles = grid(30)
    both = np.concatenate([points, points - np.array([0, 0, 1e-3])])
    kept, coarse = decimated(both, np.concatenate([triangles, triangles[:, ::-1] + len(points)]), 300)
    below = both[kept][coarse][:, :, 2] < -5e-4
    assert (below.all(axis=1) | ~below.any(axis=1)).all()
    assert below.any() and not below.all()


def test_surfaces_follow_nodes_and_refuse_what_does_not_fit() -> None:
    surfaces = Surfaces({"a": tet(), "b": tet("b", shift=5.0)})
    assert len(surfaces.points) == 8 and len(surfaces.triangles) == 8
    moved = surfaces.parts["b"].mesh.rest + np.array([0, 0, 2])
    assert surfaces.move("b", moved)
    assert_allclose(surfaces.points[4:], moved)
    assert surfaces.nearest(np.array([5.1, 5.1, 8.2])) == ("b", 7)
    assert (
        not surfaces.move("b", moved[:3]) and not surfaces.move("b", moved * np.nan) and not surfaces.move("c", moved)
    )
    assert_allclose(surfaces.points[4:], moved)


def test_a_skin_is_drawn_in_place_of_the_surface() -> None:
    mesh = tet()
    skin = SimpleNamespace(
        nodes=np.array([[0, 1, 2, 3]] * 3, np.int32), triangles=np.array([[0, 1, 2]], np.int32),
        weights=np.array([[0.25] * 4, [1, 0, 0, 0], [0, 0.5, 0.5, 0]]),
    )  # fmt: skip
    surfaces = Surfaces({"a": SimpleNamespace(**vars(mesh) | {"skin": skin})})  # type: ignore[dict-item]
    surfaces.move("a", mesh.rest * 2)
    assert_allclose(surfaces.points, [[0.5, 0.5, 0.5], [0, 0, 0], [1, 1, 0]], atol=1e-7)


def test_bands_have_each_triangle_once_in_the_colour_of_its_value() -> None:
    triangles = grid(20)[1]
    band = (triangles[:, 0] * 3) % BANDS
    found = split(triangles, band, [(k, k, k) for k in range(BANDS)])
    assert_array_equal(
        np.concatenate([b.vertices[b.triangles] for b in found]), triangles[np.argsort(band, kind="stable")]
    )
    assert [b.color[0] for b in found] == list(range(BANDS))


@pytest.mark.parametrize(("mode", "legend"), [("displacement", "to 1 m"), ("von Mises stress", "Pa")])
def test_the_largest_value_has_the_last_colour(mode: str, legend: str) -> None:
    surfaces = Surfaces({"a": tet(), "b": tet("b", shift=5.0)})
    paint = Paint(surfaces, mode)
    before = paint.version
    pulled = surfaces.parts["b"].mesh.rest.copy()
    pulled[:, 0] = 5 + 2 * (pulled[:, 0] - 5)
    surfaces.move("b", pulled)
    paint.update()
    assert paint.version > before and legend in paint.legend
    last, first = paint.bands[-1].vertices, paint.bands[0].vertices
    assert set(first) >= {0, 1, 2, 3} and set(last) <= {4, 5, 6, 7}
    assert mode == "displacement" or set(last) == {
        4,
        5,
        6,
        7,
    }  # of a displacement triangles have the mean of their corners


def test_materials_have_a_colour_each() -> None:
    paint = Paint(Surfaces({"a": tet(), "b": tet("b", young=1e6, shift=5.0), "c": tet("c", shift=9.0)}), "material")
    assert [len(band.triangles) for band in paint.bands][:2] == [8, 4]
    assert "1e+05, 1e+06" in paint.legend


def test_no_material_is_shown_that_is_not_there() -> None:
    """Three elements in a row, the outer ones soft and stiff: nothing between them is a mean of both."""
    rest = np.array([[k, float(k % 2), float(k % 3 == 0)] for k in range(6)])
    tets = np.array([[0, 1, 2, 3], [1, 2, 3, 4], [2, 3, 4, 5]], np.int32)
    young = np.array([1e3, 1e7, 1e7], np.float32)
    mesh = replace(tet(), rest=rest, tets=tets, young=young, poisson=np.full(3, 0.3, np.float32))
    other = tet("b", young=1e5, shift=20.0)  # a modulus between both, elsewhere
    rubber = replace(tet("c", shift=40.0), young=np.zeros(0, np.float32))
    paint = Paint(Surfaces({"a": mesh, "b": other, "c": rubber}), "material")
    assert "1e+03, 1e+05, 1e+07; grey" in paint.legend
    assert set(paint.bands[1].vertices) == {4, 5, 6, 7} and len(paint.bands[3].triangles) == 4
    skin = Skin(tets, np.full((3, 4), 0.25), np.array([[0, 1, 2]], np.int32))
    paint = Paint(Surfaces({"a": replace(mesh, skin=skin)}), "material")
    assert len(paint.bands[1].triangles) == 1  # of its vertices two lie in stiff elements


def test_a_scale_follows_what_becomes_less_and_ends_above_nothing() -> None:
    surfaces = Surfaces({"a": tet()})
    surfaces.move("a", tet().rest * 2)
    paint = Paint(surfaces, "displacement")
    assert "to 1 m" in paint.legend
    surfaces.move("a", tet().rest)
    for _ in range(500):
        paint.update()
    assert "to 1e-05 m" in paint.legend


def test_stresses_and_materials_take_moduli_that_were_set() -> None:
    surfaces = Surfaces({"a": tet()})
    surfaces.take_moduli({"a": tet(young=3e6)})
    assert "3e+06" in Paint(surfaces, "material").legend
    assert surfaces.parts["a"].mesh.young[0] == 3e6 and len(surfaces.points) == 4


def test_curves_show_the_worst_of_several_steps_and_begin_anew_after_a_reset() -> None:
    history = History(["a"])
    header = pb.Header(object="a")
    for step in range(1000):
        count = 77 if step == 501 else 5
        history.add([pb.ObjectStep(header=header, time=0.005 * step, iterations=count, factor_age=-1, residual=1e-7)])
    times, columns = history.columns()
    assert len(times) <= POINTS and (np.diff(times) > 0).all()
    assert columns["iterations"].max() == 77 and np.isnan(columns["age"]).all()
    history.add([pb.ObjectStep(header=header, time=11.0, iterations=3)])
    assert history.columns()[0][0] == pytest.approx(1.04, abs=0.02)
    history.add([pb.ObjectStep(header=header, time=0.0, iterations=3)])
    assert_array_equal(history.columns()[1]["iterations"], [[3]])


def test_many_objects_share_one_curve() -> None:
    history = History([f"o{k}" for k in range(9)])
    history.add([pb.ObjectStep(header=pb.Header(object=f"o{k}"), time=1.0, iterations=k) for k in range(9)])
    assert history.names == ["largest"]
    assert_array_equal(history.columns()[1]["iterations"], [[8]])


class Server:
    """Remembers commands; the answer to a grab comes when the test says so."""

    def __init__(self) -> None:
        self.sent: list[tuple[str, int, float]] = []
        self.answer: Callable[[pb.Reply | None], None] = lambda reply: None

    def send(self, verb: str, interaction: pb.Interaction, answered: Callable[[pb.Reply | None], None]) -> int:
        self.sent.append((verb, interaction.id, interaction.target.x))
        if verb == "grab":
            self.answer = answered
        return len(self.sent)


def hand(server: Server, refused: Callable[[str], None] = lambda why: None) -> Hand:
    return Hand(server, "a", 0, (0, 0, 0), (0, 0, 0), 0.1, 10.0, 5.0, refused)  # type: ignore[arg-type]


def test_a_grab_that_is_not_known_yet_is_moved_and_released_once_it_is() -> None:
    server = Server()
    held = hand(server)
    held.move((1, 0, 0))
    held.move((2, 0, 0))
    assert [verb for verb, *_ in server.sent] == ["grab"]
    server.answer(pb.Reply(interaction=pb.Interaction(id=9)))
    held.move((3, 0, 0))
    held.release()
    held.release()
    held.move((4, 0, 0))
    assert server.sent[1:] == [("move", 9, 2), ("move", 9, 3), ("release", 9, 0)]
    early = hand(server)
    early.release()
    server.answer(pb.Reply(interaction=pb.Interaction(id=10)))
    assert server.sent[-1] == ("release", 10, 0)


def test_a_refused_grab_is_told_once() -> None:
    server, why = Server(), list[str]()
    held = hand(server, why.append)
    server.answer(pb.Reply(error="no"))
    held.move((1, 0, 0))
    held.release()
    assert why == ["no"] and held.over and len(server.sent) == 1


def test_a_spring_bears_the_weight_and_bends_what_is_stiff() -> None:
    soft = grip(tet(young=1e2), {"density": 600, "effects": {"touch": {"max_force": 7}}})
    assert soft.stiffness == pytest.approx(9.81 * 100 / (0.25 * soft.size)) and soft.limit == 7
    stiff = grip(tet(young=1e9), {"density": [1], "effects": {"touch": True}})
    assert stiff.stiffness == pytest.approx(0.02 * 1e9 * stiff.size) and stiff.limit == 1e4
    assert described_objects(json.dumps({"object": [{"name": "a", "density": 3}]})) == {
        "a": {"name": "a", "density": 3}
    }
    assert described_objects("no JSON") == {}


def test_the_camera_sees_the_whole_box_from_above() -> None:
    view = home(np.zeros(3), np.array([1.0, 2.0, 8.0]), up_of('{"effects": {"gravity": {"g": [0, -9.81, 0]}}}'))
    assert_allclose(view.up, [0, 1, 0])
    assert view.position[1] > 2 and view.position[0] - view.target[0] > abs(view.position[2] - view.target[2])
    assert_allclose(up_of("{}"), [0, 1, 0])


def test_names_and_values_of_parameters() -> None:
    assert named("object.a.effects.corotational.young") == ("a", "corotational.young")
    assert named("effects.gravity.g") == ("scene", "gravity.g") and named("dt") == ("scene", "dt")
    assert named("obstacle.floor.friction") == ("floor", "friction")
    assert value_of("[0, -1.5, 0]") == [0, -1.5, 0] and value_of("= no TOML") is None


def test_names_in_tables_are_no_markup() -> None:
    status = pb.Status(objects=[pb.ObjectStatus(object="<b>x</b>")])
    assert "&lt;b&gt;x" in tables(status) and "<b>" not in tables(status)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("8081", ("127.0.0.1", 8081)),
        ("0.0.0.0:80", ("0.0.0.0", 80)),
        ("[::1]:9", ("::1", 9)),
        ("0.0.0.0", ("0.0.0.0", 8080)),
        ("localhost", ("localhost", 8080)),
        ("::1", ("::1", 8080)),
    ],
)
def test_addresses_of_the_page(text: str, found: tuple[str, int]) -> None:
    assert web_address(text) == found
    assert bool(exposed(*found)) == (found[0] == "0.0.0.0")


@pytest.mark.parametrize("text", ["", "host", "host:0", "host:70000", "a b:80", "8x"])
def test_bad_addresses_are_refused(text: str) -> None:
    with pytest.raises(Refused, match="HOST:PORT"):
        web_address(text)


@pytest.mark.parametrize(
    ("origin", "host", "loopback", "refused"),
    [
        ("http://127.0.0.1:8080", "127.0.0.1:8080", True, False),
        (None, "localhost:8080", True, False),  # a program, not a browser
        ("http://evil.example", "127.0.0.1:8080", True, True),
        ("http://127.0.0.1:9", "127.0.0.1:8080", True, True),
        ("http://evil.example:8080", "evil.example:8080", True, True),  # a name that was made to mean loopback
        ("http://lab:8080", "lab:8080", False, False),
        ("null", "lab:8080", False, True),
    ],
)
def test_other_sites_are_kept_out(origin: str | None, host: str, loopback: bool, refused: bool) -> None:
    pytest.importorskip("viser")
    from clients.web.origin import foreign

    assert foreign(origin, host, loopback) == refused


def test_the_page_says_why_it_cannot_be_served(monkeypatch: pytest.MonkeyPatch) -> None:
    with FakeServer() as taken:
        port = int(taken.endpoint.rpartition(":")[2])
        assert shown("127.0.0.1", port) in hindrance("127.0.0.1", port)
    monkeypatch.setattr("protocol.network.web_address.find_spec", lambda name: None)
    assert "pip install" in hindrance("127.0.0.1", 8080)


def test_a_page_that_ends_is_started_again_after_a_pause_that_doubles_and_given_up_at_last() -> None:
    now, started = [0.0], list[SimpleNamespace]()

    def start(command: list[str]) -> SimpleNamespace:
        assert command[command.index("--parent") + 1] == str(os.getpid())
        started.append(SimpleNamespace(returncode=None, poll=lambda: started[-1].returncode))
        if len(started) == 3:
            raise OSError("no memory")
        return started[-1]

    page = WebPage("sim", "tcp/h:1", "127.0.0.1", 8080, clock=lambda: now[0], start=start)  # type: ignore[arg-type]

    def end(pause: float, starts: int = 1) -> None:
        """Ends the page; it is started again after a pause."""
        started[-1].returncode, count = 1, len(started)
        page.check()
        now[0] += 0.9 * pause
        page.check()
        assert len(started) == count
        now[0] += 0.2 * pause
        page.check()
        assert len(started) == count + starts

    page.check()
    assert len(started) == 1
    for restart in range(MOST_RESTARTS):
        end(2**restart * FIRST_PAUSE)
    now[0] += 1.1 * LASTED
    for restart in range(MOST_RESTARTS):
        end(2**restart * FIRST_PAUSE)
    end(1e6, starts=0)
    page.close()


class CutServer:
    """Stands in for a connection to a server that cuts a body again while it answers with the mesh before."""

    def __init__(self, *_: object, **__: object) -> None:
        self.asked = self.questions = 0
        self.link: Link | None = None
        self.done = threading.Event()
        self._frames: list[Frame] = []

    def told(self, epoch: int) -> None:
        assert self.link is not None
        self._frames = [Frame("a", epoch, epoch, 0.0, tet().rest, tet().rest)]
        self.link.frames()

    def meshes(self) -> dict[str, Mesh]:
        self.asked += 1
        if self.asked == 2:
            self.told(epoch=3)  # the last frame before a pause
        if self.asked == 3:
            raise ClientError("late")
        return {"a": replace(tet(), epoch=min(self.asked, 3))}

    def status(self) -> pb.Status:
        self.questions += self.asked > 1
        if self.questions > 5 or self.asked > 3:
            self.done.set()
        return pb.Status()

    def newest(self) -> list[Frame]:
        found, self._frames = self._frames, []
        return found

    def scene(self) -> pb.Scene:
        return pb.Scene(objects=["a"])

    def states(self, _: object) -> "CutServer":
        return self

    def parameters(self) -> list[pb.LiveParameter]:
        return []

    def steps(self) -> None: ...

    def close(self) -> None: ...

    def obstacles(self) -> dict[str, object]:
        return {}


def test_a_page_gets_the_mesh_of_a_cut_that_came_while_it_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """The run is paused after the last cut, so that no other frame tells of it; one answer comes too late."""
    monkeypatch.setattr(feed_module, "Client", CutServer)
    monkeypatch.setattr(feed_module, "MESH_PERIOD", 0.0)
    monkeypatch.setattr(feed_module, "STATUS_PERIOD", 0.01)
    link = Link("sim", None)
    try:
        server: CutServer = link.client  # type: ignore[assignment]
        server.link = link
        server.told(epoch=2)
        assert server.done.wait(60)
    finally:
        link.close()
    assert link.take_meshes() == "cut" and link.meshes["a"].epoch == 3


@pytest.mark.system
def test_a_page_notices_that_its_server_is_gone() -> None:
    with FakeServer() as server:
        feed = Feed("sim", [server.endpoint])
        assert feed.check() and feed.link is not None
        assert set(feed.link.meshes) == {"beam", "liver"}
    try:
        until(feed.check, "the loss of the server")
        assert feed.link is None and feed.error
    finally:
        feed.close()


@pytest.mark.system
def test_a_server_starts_a_page_and_ends_it(tmp_path: Path) -> None:
    pytest.importorskip("viser")
    stage, port = Stage(tmp_path), free_port()
    try:
        server = stage.server(beam(tmp_path), "--web", str(port))
        address = f"http://127.0.0.1:{port}"
        until(lambda: address in server.output(), "a page")
        with urllib.request.urlopen(address, timeout=60) as answer:
            assert answer.status == 200 and b"<html" in answer.read(1000).lower()
        foreign_request = urllib.request.Request(address, headers={"Origin": "http://evil.example"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(foreign_request, timeout=60)
        assert server.end() == 0
        assert not hindrance("127.0.0.1", port)  # nobody listens there any more
        again = stage.server(beam(tmp_path), "--web", "nonsense:1x")
        assert again.wait() == 2 and "HOST:PORT" in again.output()
    finally:
        stage.close()


class Viewer:
    """Stands in for viser's handle of a tab: remembers what the person is told."""

    client_id = 1

    def __init__(self) -> None:
        self.told: list[str] = []
        self.gui = MagicMock()

    def add_notification(self, title: str, text: str, **options: object) -> None:
        self.told.append(text)


def test_a_tab_tries_again_to_connect_says_so_and_its_sliders_live_on(monkeypatch: pytest.MonkeyPatch) -> None:
    connected = list[object]()
    server = SimpleNamespace(sent=list[object](), close=lambda: None)
    server.set = server.sent.append

    def connect(*arguments: object) -> object:
        connected.append(arguments)
        if len(connected) == 1:
            raise ClientError("it is busy")
        return server

    monkeypatch.setattr("clients.web.tab.Client", connect)
    monkeypatch.setattr("clients.web.tab.RETRY_PERIOD", 0.0)
    link = SimpleNamespace(client=SimpleNamespace(name="sim"))
    page = SimpleNamespace(
        asked=lambda: None, surfaces=None, grips={}, feed=SimpleNamespace(link=link, connect=None), home=None
    )
    viewer = Viewer()
    tab = Tab(page, viewer, "plain")  # type: ignore[arg-type]
    try:
        tab.set("a", 1)
        until(lambda: len(viewer.told) == 1, "word of the change that was not made")
        assert "it is busy" in viewer.told[0]
        tab.keep_connected()
        until(lambda: tab.client is server, "another attempt")
        tab.keep_connected()
        tab.set("a", 2)
        until(lambda: server.sent == [{"a": 2}], "the change")
        assert len(connected) == 2
    finally:
        tab.close()


def live(
    value: str, low: float = 0.0, high: float = 0.0, key: str = "object.a.effects.corotational.young"
) -> pb.LiveParameter:
    return pb.LiveParameter(now=pb.Parameter(key=key, value=value), unit="Pa", low=low, high=high, logarithmic=True)


def test_one_slider_is_a_factor_of_the_stiffness_of_all_regions() -> None:
    handle, sent = SimpleNamespace(min=-1.0, max=1.0, value=0.0, label="", moved=None), list[object]()
    handle.on_update = lambda function: setattr(handle, "moved", function)
    gui = MagicMock()
    gui.add_slider.return_value = handle
    start = live('[{ "where" = "Z < \\"1\\"", "young" = 4e4 }, { "young" = 2000000 }]')
    Slider(gui, start, lambda *change: sent.append(change))
    assert gui.add_slider.call_args.args[:3] == ("corotational.young: stiffness x 1", -1.0, 1.0)
    handle.value = 0.4
    asyncio.run(handle.moved(SimpleNamespace(client_id=7)))
    ((number, key, text),) = sent
    assert (number, key) == (7, start.now.key) and handle.label.endswith("stiffness x 2.512")
    assert value_of(text) == [{"where": 'Z < "1"', "young": 100480.0}, {"young": 5024000.0}]
    fresh = Slider(gui, start, lambda *change: None)
    fresh.show(live(text))
    assert handle.value == 0.4 and handle.label.endswith("x 2.512")
    fresh.show(live('[{ "where" = "Z < 2", "young" = 1e4 }, { "young" = 1e4 }]'))  # other regions, by another client
    assert handle.value == 0.0 and handle.label.endswith("x 1")


def test_sliders_are_made_anew_for_other_bounds_and_other_kinds_of_values() -> None:
    gui = MagicMock()
    gui.add_slider.return_value = MagicMock(min=-9.0, max=9.0)
    sliders = Sliders(gui, MagicMock(), lambda *change: None)
    counts = []
    for value, high in (("1e5", 1e6), ("2e5", 1e6), ("2e5", 1e7), ('[{ "young" = 1e5 }]', 1e7)):
        sliders.update([live(value, 1e4, high)])
        counts.append(gui.add_slider.call_count)
    assert counts == [1, 1, 2, 3]
    assert gui.add_slider.call_args_list[1].args[2] == 7.0


def test_a_blade_is_held_along_the_line_of_sight() -> None:
    corners = np.array(swept((0, 0, 0), (1, 0, 0), np.array([0.5, 0, 5.0]), 2.0))
    np.testing.assert_allclose(corners, [[0, 0, 2], [1, 0, 2], [1, 0, -2], [0, 0, -2]])
