# SPDX-License-Identifier: MIT
"""Films (GIF) and stills of a log, drawn by the processor alone: bodies, obstacles, hands of clients and a caption."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clients.errors import BadInput
from clients.log.frames import Frame
from clients.log.obstacles import Obstacle
from clients.log.reader import Log
from clients.viewer.obstacle_surface import obstacle_surface
from clients.viewer.painter import Camera, Piece, ball, paint, rod
from clients.viewer.surface import Surface
from protocol import messages_pb2 as pb
from protocol.log_file import LogFile

if TYPE_CHECKING:
    from PIL.Image import Image

BODIES = np.array([(226, 122, 95), (88, 150, 200), (120, 178, 110), (226, 178, 80), (160, 120, 190)], float)
HAND, STONE = (52, 60, 84), (176, 182, 192)  # colours of hands and of obstacles
TEXT = (70, 76, 92)
SAMPLES = 48  # frames from which the camera takes what it has to have in view
COLORS = 128  # of a GIF: fewer make it smaller


@dataclass(frozen=True)
class Angle:
    """From where a camera looks [degrees], and how near: 1 has the box around the bodies just in view."""

    azimuth: float = 28.0
    elevation: float = 14.0
    nearness: float = 1.5


FRONT = Angle()


class Stage:
    """The frames of a log, drawn from one place. names: of the objects in it, None: all. Raises BadInput if the log has
    none."""

    def __init__(
        self, log: Log, size: tuple[int, int], angle: Angle = FRONT, names: Sequence[str] | None = None
    ) -> None:
        self._log, self._size = log, size
        wanted = log.objects if names is None else names
        self._names = sorted(name for name in wanted if log.object_log(name).frames)
        if not self._names:
            raise BadInput(f"{log.path}: no frames were recorded")
        self._surfaces: dict[str, tuple[int, Surface]] = {}  # object -> epoch and surface of the frame drawn last
        self._times = {name: np.array([f.time for f in log.frames(name)]) for name in self._names}
        self._scalars = {name: log.scalars(name) for name in self._names}
        self._hands = _hands(log)
        low, high = self._box()
        camera = Camera.around(low, high, angle.azimuth, angle.elevation, size[0] / size[1])
        self._camera = Camera(camera.target + (camera.eye - camera.target) / angle.nearness, camera.target)
        self._floor = float(low[1])
        self._rods = float(np.linalg.norm(high - low)) / 220
        self._solids = [_solid(o, low, high) for o in log.obstacles.values()]
        self._poses = {name: np.array([pose.time for pose in poses]) for name, poses in log.poses.items() if poses}

    @property
    def begin(self) -> float:
        """Time of the first frame [s]."""
        return float(min(times[0] for times in self._times.values()))

    @property
    def end(self) -> float:
        """Time of the last frame [s]."""
        return float(max(times[-1] for times in self._times.values()))

    def draw(self, time: float, caption: bool = True) -> Image:
        """Returns the picture of the frames at a time [s]."""
        pieces, frames = [self._placed(solid, time) for solid in self._solids], {}
        for number, name in enumerate(self._names):
            frame = frames[name] = self._frame(name, time)
            surface = self._surface(frame)
            pieces.append(Piece(surface.points(frame.x), surface.triangles, BODIES[number % len(BODIES)]))
        for hand in self._hands.at(max(frame.step for frame in frames.values())):
            if hand.object not in frames:
                continue
            held = self._hands.held(hand, frames[hand.object].x)
            target = np.array([hand.target.x, hand.target.y, hand.target.z])
            pieces += [ball(held, 2.5 * self._rods, HAND), rod(held, target, self._rods, HAND)]
            pieces.append(ball(target, 2.5 * self._rods, HAND))
        picture = paint(pieces, self._camera, self._size, self._floor)
        return self._captioned(picture, frames) if caption else picture

    def _placed(self, solid: tuple[Obstacle, Piece], time: float) -> Piece:
        """Returns an obstacle where it is at a time [s]."""
        obstacle, piece = solid
        pose = obstacle.start
        if obstacle.name in self._poses and time >= self._poses[obstacle.name][0]:
            pose = self._log.poses[obstacle.name][int(np.abs(self._poses[obstacle.name] - time).argmin())].pose
        return Piece(piece.x @ pose.matrix().T + pose.position, piece.triangles, piece.color)

    def _surface(self, frame: Frame) -> Surface:
        """Returns the surface of the mesh that a frame has."""
        epoch, surface = self._surfaces.get(frame.object, (-1, None))
        if surface is None or epoch != frame.epoch:
            surface = Surface(self._log.mesh(frame.object, frame.epoch), "displacement")
            self._surfaces[frame.object] = frame.epoch, surface
        return surface

    def _frame(self, name: str, time: float) -> Frame:
        times = self._times[name]
        return self._log.frame(name, int(np.abs(times - time).argmin()))

    def _box(self) -> tuple[NDArray, NDArray]:
        """Returns the corners of a box around the bodies at some of the frames [m]."""
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for name in self._names:
            count = len(self._times[name])
            for index in np.unique(np.linspace(0, count - 1, min(count, SAMPLES)).astype(int)):
                frame = self._log.frame(name, int(index))
                x = self._surface(frame).points(frame.x)
                if len(x) and np.isfinite(x).all():
                    low, high = np.minimum(low, x.min(axis=0)), np.maximum(high, x.max(axis=0))
        return low, high

    def _captioned(self, picture: Image, frames: dict[str, Frame]) -> Image:
        """Writes elements, iterations and age of the factor below; of the object with most iterations."""
        from PIL import ImageDraw, ImageFont

        tets = sum(len(self._log.mesh(name, frame.epoch).tets) for name, frame in frames.items())
        words = [f"{tets:,} tetrahedra"]
        rows = []
        for name, frame in frames.items():
            scalars = self._scalars[name]
            here = np.flatnonzero(scalars["step"] == frame.step)
            rows += [(scalars["iterations"][here[0]], scalars["factor_age"][here[0]])] if len(here) else []
        if rows:
            iterations, age = max(rows)
            words.append(f"{iterations} iterations a step")
            words += [f"factor {age} step{'' if age == 1 else 's'} old"] if age >= 0 else []
        font = ImageFont.load_default(self._size[1] / 24)
        ImageDraw.Draw(picture).text(
            (self._size[0] / 2, self._size[1] * 0.965), "  ·  ".join(words), TEXT, font, anchor="mm"
        )
        return picture


def _solid(obstacle: Obstacle, low: NDArray, high: NDArray) -> tuple[Obstacle, Piece]:
    """Returns an obstacle and its surface in its own frame; a plane has no triangles, since the picture has a floor."""
    vertices, triangles = obstacle_surface(obstacle, low, high)
    shown = triangles[:0] if obstacle.shape == "plane" else triangles
    return obstacle, Piece(np.reshape(vertices, (-1, 3)), np.reshape(shown, (-1, 3)), np.array(STONE, float))


class _Hands:
    """Grabs of clients as the log has them: all from a step on, and which nodes each holds."""

    def __init__(self, sets: list[pb.TouchSet], first: dict[str, int]):
        self._sets = sorted(sets, key=lambda found: found.step)
        self._first = first  # node of the scene of each object
        self._nodes = {i.id: np.frombuffer(i.held, np.int32) for s in self._sets for i in s.interactions if i.held}

    def at(self, step: int) -> list[pb.Interaction]:
        """Returns the grabs in the step that ended with this state."""
        past = [found for found in self._sets if found.step < step]
        return [i for i in past[-1].interactions if i.kind == "grab"] if past else []

    def held(self, hand: pb.Interaction, x: NDArray) -> NDArray:
        """Returns the mean position of the nodes that a grab holds [m]. x (n, 3): of its object"""
        nodes = self._nodes.get(hand.id, np.zeros(0, np.int32)) - self._first.get(hand.object, 0)
        if not len(nodes):
            return np.array([hand.point.x, hand.point.y, hand.point.z])
        mean: NDArray = x[nodes].mean(axis=0)
        return mean


def _hands(log: Log) -> _Hands:
    with LogFile.open(log.path) as file:
        sets = [pb.TouchSet.FromString(message.data) for message in file.messages() if message.topic == "/touch"]
    first, count = {}, 0
    for table in json.loads(log.scene.resolved)["object"] if log.scene and log.scene.resolved else ():
        first[table["name"]] = count
        count += len(next(iter(log.object_log(table["name"]).meshes.values())).rest)
    return _Hands(sets, first)


def gif(
    log: Log, begin: float, end: float, rate: float = 12.0, size: tuple[int, int] = (480, 400), angle: Angle = FRONT
) -> bytes:
    """Returns a GIF of a log from one time to another [s], in real time. rate: frames in a second."""
    from PIL import Image

    stage = Stage(log, size, angle)
    times = np.arange(begin, min(end, stage.end) + 1e-9, 1 / rate)
    pictures = [stage.draw(float(time)) for time in times] or [stage.draw(begin)]
    # One palette for all: with one of each the background would flicker, and nothing of a frame could be left out.
    sample = Image.new("RGB", (size[0], 3 * size[1] + 40), HAND)  # also of what is small
    sample.paste(TEXT, (0, 0, size[0] // 2, 40))
    for k in range(3):
        sample.paste(pictures[k * (len(pictures) - 1) // 2], (0, 40 + k * size[1]))
    palette = sample.quantize(COLORS, dither=Image.Dither.NONE)
    frames = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    file = BytesIO()
    frames[0].save(
        file, "GIF", save_all=True, append_images=frames[1:], duration=round(1000 / rate), loop=0, optimize=False
    )
    return file.getvalue()
