# SPDX-License-Identifier: MIT
"""Films of hard cases: python -m tests.bench.hard_cases.film writes docs/figures/hard_cases.gif, ten that hold, and
hard_cases_failures.gif, all that are known to fail. --only NAME: other ones, to --to FILE.gif.

Each panel is a case from its start on, in its own time; elements that are inside out are dark.
"""

import tempfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from clients.viewer.painter import Camera, Piece, paint
from sim_server.simulation import Simulation
from tests.bench.hard_cases.measuring import TABLES
from tests.bench.harness.report import ROOT
from tests.hard_cases.of_effects import run_effect_case
from tests.hard_cases.running import run_case

FOLDER = ROOT / "docs" / "figures"
TEN = {  # steps that are shown
    "random": 120, "a point": 240, "inside out, Z": 90, "swapped layers": 60, "stretched 10 times": 700,
    "spin 100 rad/s": 60, "violent push on one node": 120, "pressed flat: corotational": 60,
    "4 turns: stable_neo_hookean": 460, "50 m/s on the floor": 60,
}  # fmt: skip
PANEL, FRAMES, RATE = (184, 184), 72, 12  # pixels; frames of the film, and in a second
COLUMNS, COLORS = 5, 64
BODY, INVERTED = (226, 122, 95), (60, 60, 80)
Reals = NDArray[np.float64]


@dataclass(frozen=True)
class Clip:
    """Positions (frames, nodes, 3) of a run, its elements (m, 4), positions at rest (nodes, 3)."""

    name: str
    x: Reals
    tets: NDArray[np.int64]
    rest: Reals


def clip(name: str, steps: int = 0) -> Clip:
    """The first steps of a case, all of them: 0."""
    kind = next(kind for kind in ("case", "effect", "model") if name in TABLES[kind])
    case, seen, sims = TABLES[kind][name], list[Reals](), list[Simulation]()

    def watch(sim: Simulation) -> None:
        sims[:] = [sim]
        seen.append(sim.world.x.copy())

    with tempfile.TemporaryDirectory() as folder, np.errstate(all="ignore"):
        if kind == "effect":
            run_effect_case(case, 0, watch=watch)
        else:
            run_case(case, Path(folder), watch=watch)
    finite = [x for x in seen[: steps or None] if np.isfinite(x).all()]
    world = sims[0].world
    tets = np.concatenate([body.mesh.tets + body.first for body in world.bodies])
    shown = np.linspace(0, len(finite) - 1, FRAMES).astype(int)
    return Clip(name, np.array([finite[k] for k in shown]), tets, world.rest.copy())


def skin(tets: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangles of one element alone, normals outward, and their elements."""
    faces = np.concatenate([tets[:, [0, 2, 1]], tets[:, [0, 1, 3]], tets[:, [1, 2, 3]], tets[:, [0, 3, 2]]])
    owner = np.tile(np.arange(len(tets)), 4)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    alone = first[count == 1]
    return faces[alone], owner[alone]


def panels(shown: Clip) -> Iterable[Any]:
    """The pictures of a clip."""
    from PIL import ImageDraw, ImageFont

    triangles, owner = skin(shown.tets)
    often = shown.x[len(shown.x) // 6 :]  # the first ones may be far away
    low, high = np.quantile(often, 0.01, axis=(0, 1)), np.quantile(often, 0.99, axis=(0, 1))
    low, high = np.minimum(low, shown.rest.min(axis=0)), np.maximum(high, shown.rest.max(axis=0))
    camera = Camera.around(low, high, 62, 16, PANEL[0] / PANEL[1])
    font = ImageFont.load_default(11)
    words = shown.name.replace(": ", ":\n", 1)
    rest = _volumes(shown.rest, shown.tets)
    for x in shown.x:
        color = np.tile(np.array(BODY, float), (len(triangles), 1))
        color[(_volumes(x, shown.tets) * rest <= 0)[owner]] = INVERTED
        picture = paint([Piece(x, triangles, color)], camera, PANEL, float(low[1]))
        place = (PANEL[0] / 2, PANEL[1] - 4 - 7 * len(words.split("\n")))
        ImageDraw.Draw(picture).text(place, words, (70, 76, 92), font, anchor="mm", align="center")
        yield picture


def _volumes(x: Reals, tets: NDArray[np.int64]) -> Reals:
    corners = x[tets]
    return np.asarray(np.linalg.det(corners[:, 1:] - corners[:, :1]))


def film(clips: list[Clip], to: Path) -> None:
    """All clips beside each other, as a GIF."""
    from PIL import Image

    rows = -(-len(clips) // COLUMNS)
    sheets = [Image.new("RGB", (min(COLUMNS, len(clips)) * PANEL[0], rows * PANEL[1]), "white") for _ in range(FRAMES)]
    for k, each in enumerate(clips):
        for sheet, panel in zip(sheets, panels(each), strict=True):
            sheet.paste(panel, (k % COLUMNS * PANEL[0], k // COLUMNS * PANEL[1]))
    palette = sheets[0].quantize(COLORS, dither=Image.Dither.NONE)
    frames = [sheet.quantize(palette=palette, dither=Image.Dither.NONE) for sheet in sheets]
    frames[0].save(to, "GIF", save_all=True, append_images=frames[1:], duration=round(1000 / RATE), loop=0)
    print(f"{to}: {to.stat().st_size / 1e6:.1f} MB", flush=True)


def failing() -> list[str]:
    """Names of all cases that are stated to fail."""
    return [name for kind in ("case", "effect", "model") for name, case in TABLES[kind].items() if case.fails]


def main(
    only: Annotated[list[str] | None, typer.Option(help="Names of cases, effects or models")] = None,
    to: Annotated[Path | None, typer.Option(help="The film, with --only")] = None,
) -> None:
    """Films of hard cases."""
    if only:
        film([clip(name) for name in only], to or Path("film.gif"))
        return
    film([clip(name, steps) for name, steps in TEN.items()], FOLDER / "hard_cases.gif")
    film([clip(name) for name in failing()], FOLDER / "hard_cases_failures.gif")


if __name__ == "__main__":
    typer.run(main)
