# SPDX-License-Identifier: MIT
"""What the demonstration says of its log, and what it does on a machine with a display."""

import importlib.util
import io
import subprocess
import sys
import webbrowser
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from rich.console import Console

from clients.demo.run import take_hand
from clients.errors import BadInput
from tests.ports import free_port

DEMO = Path(__file__).parents[1] / "deploy" / "demo.py"


def the_demo() -> ModuleType:
    spec = importlib.util.spec_from_file_location("demo", DEMO)
    assert spec and spec.loader
    demo = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(demo)
    return demo


def said(ages: list[int], folder: Path) -> str:
    demo, count = the_demo(), len(ages)
    scalars = {"iterations": np.arange(1, count + 1), "factor_age": np.array(ages)}
    scalars |= {"step_seconds": np.full(count, 2e-3), "residual": np.full(count, 9e-7)}
    np.savez(folder / "creature.npz", **{f"scalars/{name}": values for name, values in scalars.items()})
    out = io.StringIO()
    Console(file=out, width=100).print(demo.summary(folder / "creature.npz"))
    return out.getvalue()


FIRST, ITERATIONS, AGE = (
    "iterations before the first factor", "iterations with a factor, mean / max", "age of the factor, mean / max"
)  # fmt: skip


@pytest.mark.parametrize(
    ("ages", "rows"),
    [
        ([-1, -1, 0, 1], {FIRST: "2", ITERATIONS: "3.5 / 4", AGE: "0.5 / 1 steps"}),
        ([-1, -1, -1], {FIRST: "2", ITERATIONS: "no factor came in time", AGE: "-"}),
        ([0, 1], {FIRST: None, ITERATIONS: "1.5 / 2", AGE: "0.5 / 1 steps"}),
    ],
    ids=["as usual", "no factor", "from the beginning"],
)
def test_the_summary_holds_whenever_factors_came(ages, rows, tmp_path):
    cells = [line.split("│") for line in said(ages, tmp_path).splitlines() if line.count("│") == 3]
    shown = {name.strip(): value.strip() for _, name, value, _ in cells}
    assert {name: shown.get(name) for name in rows} == rows
    assert shown["steps"] == str(len(ages)) and shown["largest true residual"] == "9.0e-07"


def test_the_hand_goes_smoothly_from_where_it_is_to_the_last_place() -> None:
    demo = the_demo()
    path = np.array([demo.way(part) for part in np.linspace(-0.1, 1.1, 241)])
    assert (path[0] == 0).all() and (path[-1] == demo.WAY[-1]).all()
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 0.03  # m, in three quarters of a step


@pytest.mark.parametrize(
    ("display", "page", "browser", "shown"),
    [
        (True, True, "xdg-open", True),
        (False, True, "xdg-open", False),
        (True, False, "xdg-open", False),
        (True, True, "", False),
        (True, True, "/usr/bin/w3m", False),
    ],
    ids=["all there", "no display", "no page", "no browser", "a browser for text"],
)
def test_the_page_is_shown_where_it_can_be_seen(
    display: bool, page: bool, browser: str, shown: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def get() -> webbrowser.BaseBrowser:
        if not browser:
            raise webbrowser.Error("could not locate runnable browser")
        return webbrowser.GenericBrowser(browser)

    demo = the_demo()
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.setenv("DISPLAY", ":0") if display else monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(webbrowser, "get", get)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if page else None)
    assert demo.has_browser() is shown


def test_the_page_opens_on_the_creature_and_ends_with_its_server(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Both programs are played by short scripts: the page would go on, the server ends once it is opened."""
    demo, started, opened = the_demo(), [], []
    demo.PAGE = free_port()
    page_of = f"import socket, time; s = socket.create_server(('127.0.0.1', {demo.PAGE})); time.sleep(60)"

    def tool(package: str, *arguments: str) -> list[str]:
        started.append((package, *arguments))
        return [sys.executable, "-c", "import sys; sys.stdin.read()" if package == "sim_server" else page_of]

    def open_page(address: str) -> None:
        opened.append(address)
        servers[0].stdin.close()  # it ends

    servers, popen = [], subprocess.Popen

    def popen_with_input(command: list[str], **options: object) -> "subprocess.Popen[bytes]":
        process = popen(command, stdin=subprocess.PIPE, stderr=subprocess.DEVNULL, **options)  # type: ignore[call-overload]
        servers.append(process)
        return process

    monkeypatch.setattr(subprocess, "Popen", popen_with_input)
    monkeypatch.setattr(demo, "tool", tool)
    monkeypatch.setattr(demo, "connected", nullcontext)
    monkeypatch.setattr(webbrowser, "open", open_page)
    assert demo.show() == 0
    (server, page), (address,) = started, opened
    assert server[:2] == ("sim_server", "gallery/creature") and not {"--steps", "--record"} & set(server)
    assert page[:2] == ("clients", "web") and page[page.index("--connect") + 1] == server[server.index("--listen") + 1]
    assert address == f"http://127.0.0.1:{page[page.index('--port') + 1]}" and address in capsys.readouterr().out


def test_a_hand_that_moves_fast_is_taken_all_the_same():
    """Where it was is empty: its place is asked for again, and at last the nearest node is taken."""
    asked = []

    class Client:
        def grab(self, name, at, radius, stiffness, max_force):
            asked.append((at, radius))
            if radius and at != (0.5, 0, 0):
                raise BadInput("grab: no free node")
            return "held"

    moving = iter(np.array([[[9, 9, 9], [x, 0, 0]]]).squeeze() for x in (0.1, 0.5))
    grab, start = take_hand(Client(), 1, lambda: next(moving))
    assert (grab, tuple(start)) == ("held", (0.5, 0, 0)) and len(asked) == 2
    asked.clear()
    take_hand(Client(), 0, lambda: np.zeros((2, 3)))
    assert asked[-1][1] == 0 and all(radius for _, radius in asked[:-1]) and len(asked) > 5
