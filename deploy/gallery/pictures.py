# SPDX-License-Identifier: MIT
"""Makes the pictures of docs/gallery.md: python -m deploy.gallery.pictures [NAME...] writes docs/figures/gallery.

Each scene of the gallery runs in real time while a client drags a body; those that show an effect run by themselves,
but for the liver, which a client pushes and cuts. The picture is that of the last step, drawn by the processor.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from clients.client import Client
from clients.log.reader import Log
from clients.viewer.film import FRONT, Angle, Stage
from deploy.demo import connected, ended, start

FOLDER = Path(__file__).resolve().parents[2] / "docs" / "figures" / "gallery"
SIZE = (420, 360)  # pixels
GRAB_AT, STEPS = 60, 110
Vector = tuple[float, float, float]
Act = Callable[[Client, "subprocess.Popen[bytes]"], None]


@dataclass(frozen=True)
class Drag:
    """How a scene is shown: a grab of the nodes of an object within `radius` [m] of a point at rest, moved by `by`."""

    object: str
    at: Vector  # m
    by: Vector  # m
    radius: float  # m
    stiffness: float  # N/m
    force: float  # largest [N]
    angle: Angle = FRONT


DRAGS = {
    "beam": Drag("beam", (0.5, 0.5, 4.2), (1.2, 1.2, -0.4), 0.5, 3e4, 1.2e4, Angle(60, 12)),
    "creature": Drag("creature", (0.225, 0.283, 0.038), (0.05, 0.2, 0.12), 0.035, 400, 100),
    "jelly": Drag("middle", (0.04, 0.13, 0.03), (0.035, 0.02, 0.03), 0.02, 60, 5, Angle(28, 10, 1.15)),
    "liver": Drag("liver", (-0.09, -0.06, 0.04), (-0.1, 0.03, 0.1), 0.025, 250, 30, Angle(20, 8, 1.3)),
    "sheet": Drag("sheet", (0.35, 0.5, 0.3), (0.1, 0.2, 0.35), 0.05, 40, 15, Angle(35, 18)),
    "tentacle": Drag("tentacle", (0.19, 0.05, 0), (0.18, 0.12, 0.1), 0.03, 150, 25, Angle(20, 14)),
}


@dataclass(frozen=True)
class Effect:
    """How a scene of deploy/scenes that shows an effect is shown: after so many steps."""

    scene: str
    steps: int
    angle: Angle = FRONT


EFFECTS = {
    "beating_strip": Effect("beating_strip", 130, Angle(25, 12, 1.2)),
    "needle": Effect("needle", 90, Angle(30, 16, 1.0)),
    "soft_gripper": Effect("soft_gripper", 60, Angle(20, 14, 1.2)),
    "tendon_finger": Effect("tendon_finger", 150, Angle(25, 12, 1.2)),
    "torn_sheet": Effect("torn_sheet", 120, Angle(20, 8, 0.95)),
}
# What docs/gallery.md has a client do with the liver, by step: sim-client push, and sim-client cut.
PUSH_AT, CUT_AT, CUT_STEPS = 60, 75, 90
CUT = "liver_cut"
PUSH: dict[str, Any] = {"at": (0.12, 0.01, 0.01), "force": (0, 5, -2), "radius": 0.03, "duration": 5.0}
BLADE = [(-0.03, -0.1, 0.12), (-0.03, 0.03, 0.12), (-0.03, 0.03, 0.0), (-0.03, -0.1, 0.0)]  # corners [m]


def push_and_cut(client: Client, server: "subprocess.Popen[bytes]") -> None:
    """Pushes a lobe of the liver, and then cuts into the other one."""
    states, pushed, cut = client.states(["liver"]), False, False
    while server.poll() is None:
        time.sleep(0.01)
        for frame in states.newest():
            if frame.step >= PUSH_AT and not pushed:
                pushed = bool(client.push("liver", **PUSH))
            if frame.step >= CUT_AT and not cut:
                cut = bool(client.cut("liver", blade=BLADE))


def play(client: Client, server: "subprocess.Popen[bytes]", drag: Drag) -> None:
    """Grabs a body and moves the grab evenly until the server has made its steps."""
    node = int(np.linalg.norm(client.meshes()[drag.object].rest - drag.at, axis=1).argmin())
    states, grab, begun = client.states([drag.object]), None, np.zeros(3)
    while server.poll() is None:
        time.sleep(0.01)
        for frame in states.newest():
            if grab is None and frame.step >= GRAB_AT:
                begun = frame.x[node]
                grab = client.grab(
                    drag.object, tuple(begun), radius=drag.radius, stiffness=drag.stiffness, max_force=drag.force
                )
            elif grab is not None:
                part = min(1.0, (frame.step - GRAB_AT) / 25)
                grab.move(begun + part * np.array(drag.by), wait=False)


def picture(name: str) -> None:
    """Runs a scene and writes its picture."""
    if name in DRAGS:
        act: Act = partial(play, drag=DRAGS[name])
        run(name, f"gallery/{name}", STEPS, DRAGS[name].angle, act)
    elif name == CUT:
        run(name, "gallery/liver", CUT_STEPS, Angle(20, 8, 1.3), push_and_cut)
    else:
        shown = EFFECTS[name]
        run(name, f"deploy/scenes/{shown.scene}.toml", shown.steps, shown.angle, watched)


def watched(client: Client, server: "subprocess.Popen[bytes]") -> None:
    """Does nothing with a scene until the server has made its steps."""
    server.wait()


def run(name: str, scene: str, steps: int, angle: Angle, act: Act) -> None:
    """Runs a scene while `act` does something with it, and writes its picture."""
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / f"{name}.mcap"
        server = start(scene, "--record", str(log), "--quiet", "--steps", str(steps))
        try:
            with connected(server) as client:
                act(client, server)
        finally:
            ended(server)
        with Log(log) as opened:
            stage = Stage(opened, SIZE, angle)
            drawn = stage.draw(stage.end, caption=False)
    drawn.save(FOLDER / f"{name}.png", optimize=True)


def main(names: list[str]) -> None:
    """Makes the pictures of these names, or all."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in names or [*DRAGS, CUT, *EFFECTS]:
        picture(name)
        print(f"{name}: {(FOLDER / f'{name}.png').stat().st_size / 1e3:.0f} kB", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
