# SPDX-License-Identifier: MIT
"""`sim-client plan`: proposes settings from measured points and writes them as an overlay."""

from __future__ import annotations

import json
import shlex
import time
from pathlib import Path

from clients.accuracy.axes import SceneValues
from clients.accuracy.command import MOST_MINUTES, write
from clients.accuracy.runs import Run
from clients.accuracy.study import Study, check_scene, probe
from clients.errors import BadInput
from clients.plan import overlay
from clients.plan.answer import Answer, words
from clients.plan.combinations import untried
from clients.plan.front import Wish, choose
from clients.plan.measure import measure
from clients.plan.measurements import Measurements, read
from clients.progress import titled_progress_bar

SHARE = 0.8  # of the time for measurements that those of sim-client accuracy take, where there are none yet
DURATION = 1.0  # s that is simulated in them


def plan(scene: Path, wish: Wish, where: Path | None, to: Path | None, minutes: float, as_json: bool) -> bool:
    """Proposes settings of a scene, writes and prints them; returns False if none are as wished.

    where: of the points, a file or its folder, None: where sim-client accuracy leaves them; to: overlay to write,
    None: beside the scene; minutes: for measurements, 0: none

    Raises BadInput if there are no points of this scene, or `to` is another file.
    """
    if not 0 <= minutes <= MOST_MINUTES:
        raise BadInput(f"--measure {minutes:g}: allowed is 0 (nothing is measured) to {MOST_MINUTES:g} minutes")
    check_scene(scene)
    to = to or (scene if scene.is_file() else Path(scene.name)).with_suffix(".plan.toml")
    overlay.check_path(to)
    where = where or Path(f"accuracy-{scene.stem}")
    path = where if where.is_file() else where / "points.json"
    found, probed = measured(scene, wish, path, minutes) if minutes else answer(scene, wish, path)
    use = shlex.join([*server(scene, found, probed), "--set", f"@{to}"])
    if found.choice.reached:
        overlay.write(to, found.choice.point.settings, found.comments(overlay.MARK, use))
    if as_json:
        written = {"overlay": str(to), "use": use} if found.choice.reached else {"overlay": None, "use": None}
        print(json.dumps(found.as_json() | written, allow_nan=False))
    else:
        show(found)
        nothing = f"nothing is written; {to} is of an earlier choice" if to.exists() else "nothing is written"
        print(f"wrote {to}:\n  {use}" if found.choice.reached else nothing)
    return found.choice.reached


def show(found: Answer) -> None:
    """Prints an answer for people."""
    from rich.console import Console

    print(found.first())
    Console().print(found.table())
    for note in found.notes():
        print(f"- {note}")


def server(scene: Path, found: Answer, probed: Run) -> list[str]:
    """Returns the words that start a server as the chosen settings were measured."""
    device = found.points.found.device
    workers = SceneValues(probed.scene, device).wants_workers(found.choice.point.settings)
    return ["sim-server", str(scene), "--device", device, *(["--workers", "1"] if workers else [])]


def answer(scene: Path, wish: Wish, path: Path) -> tuple[Answer, Run]:
    """Chooses from the points in a file; returns a run of the scene as it is, too."""
    points, probed = checked(scene, path)
    return chosen(wish, points), probed


def chosen(wish: Wish, points: Measurements) -> Answer:
    """Chooses from points."""
    choice = choose(points.usable, wish, points.floor)
    return Answer(points, wish, choice, untried(points, wish, choice))


def measured(scene: Path, wish: Wish, path: Path, minutes: float) -> tuple[Answer, Run]:
    """Chooses as `answer`, after measurements: all if there are none, then combinations while time is left."""
    began = time.monotonic()
    with titled_progress_bar(60 * minutes) as progress:
        if not path.exists():
            write(Study(scene, path.parent, DURATION, "auto", progress).run(SHARE * minutes), path.parent)
        points, probed = checked(scene, path)
        while found := chosen(wish, points).untried:
            left = began + 60 * minutes - time.monotonic()

            def tick(settings: dict[str, str] = found[0]) -> None:
                progress(time.monotonic() - began, words(settings))

            if left <= 0 or not measure(scene, path, points.found, probed, found[0], left, tick):
                break
            points = read(path)
    return chosen(wish, points), probed


def checked(scene: Path, path: Path) -> tuple[Measurements, Run]:
    """Reads the points of a scene; returns them and a run of one step.

    Raises BadInput if there are none, or only those of another scene.
    """
    first = f"first: sim-client accuracy {shlex.quote(str(scene))}"
    if not path.exists():
        raise BadInput(f"{path}: no such file; settings are chosen from what was measured, {first} (or --measure 5)")
    points = read(path)
    run, known = probe(scene, points.found.device)
    if points.found.digest != known:
        raise BadInput(
            f"{path}: measured of another scene, or of this one with other values (digest {points.found.digest[:12]}, "
            f"{scene} has {known[:12]}); {first}"
        )
    if not points.usable:
        raise BadInput(f"{path}: no measurement has come to its end; {first}")
    return points, run
