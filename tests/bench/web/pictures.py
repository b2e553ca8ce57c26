# SPDX-License-Identifier: MIT
"""Makes the pictures of docs/web.md: `python -m tests.bench.web.pictures [SCENE.toml]`."""

import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from clients.web.view import home, up_of
from tests.bench.harness.report import ROOT
from tests.bench.web.__main__ import BEAM, page, served
from tests.support.browser import browser, choose_colour, on_screen, open_page

FIGURES = ROOT / "docs" / "figures"
WINDOW = {"width": 1280, "height": 720}
PULL = (-120, -60)  # pixels
SOFT = 4e5  # Young's modulus in the second picture [Pa]


def drag(tab: Any, at: tuple[float, float], by: tuple[int, int]) -> None:
    """Pulls slowly and does not let go."""
    x, y = at
    tab.mouse.move(x, y)
    tab.mouse.down()
    for k in range(1, 21):
        tab.mouse.move(x + by[0] * k / 20, y + by[1] * k / 20)
        time.sleep(0.05)
    time.sleep(3.0)


def main() -> None:
    scene = Path(sys.argv[1]) if len(sys.argv) > 1 else BEAM
    with (
        tempfile.TemporaryDirectory(prefix="warpfactor-web-") as name, browser() as chromium,
        served(Path(name), "solver.preconditioner=cholesky", scene=scene) as (client, endpoint),
        page(endpoint, Path(name)) as address,
    ):  # fmt: skip
        tab = open_page(chromium, address, WINDOW)
        time.sleep(5.0)
        mesh = next(iter(client.meshes().values()))
        view = home(mesh.rest.min(axis=0), mesh.rest.max(axis=0), up_of(client.scene().resolved))
        states = client.states()
        while not (newest := states.newest()):
            time.sleep(0.05)
        body = newest[0]
        rest, half = mesh.rest, (mesh.rest.min(axis=0) + mesh.rest.max(axis=0)) / 2
        side = np.flatnonzero(rest[:, 0] > rest[:, 0].max() - 1e-6)  # which the camera sees
        end = side[rest[side, 2] > rest[side, 2].max() - 1e-6]
        tip = int(end[np.abs(rest[end, 1] - half[1]).argmin()])
        drag(tab, on_screen(tab, view, body.x[tip]), PULL)
        tab.screenshot(path=FIGURES / "web.png")
        tab.mouse.up()
        choose_colour(tab, "von Mises stress")
        time.sleep(4.0)
        drag(tab, on_screen(tab, view, body.x[tip]), PULL)
        client.set(f"{mesh.object}.corotational.young", SOFT)
        time.sleep(4.0)
        tab.screenshot(path=FIGURES / "web_soft.png")
        tab.mouse.up()


if __name__ == "__main__":
    main()
