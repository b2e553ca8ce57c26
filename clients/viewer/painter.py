# SPDX-License-Identifier: MIT
"""Draws surfaces by the processor alone: triangles from far to near (painter's algorithm), lit, with a soft shadow.

For pictures and films where neither a display nor a graphics driver is. Needs Pillow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clients.errors import ClientError
from protocol.process.extras import to_install

if TYPE_CHECKING:
    from PIL.Image import Image

FINER = 2  # drawn so many times larger, then made smaller: smooth edges
VIEW = np.radians(24.0)  # height of the field of view
LIGHT = np.array([0.35, 0.85, 0.45]) / np.linalg.norm([0.35, 0.85, 0.45])  # direction towards the light
AMBIENT, SHINE = 0.42, 0.22
SKY, FLOOR, SHADOW = (250, 250, 252), (226, 230, 236), (150, 158, 172)


@dataclass(frozen=True)
class Camera:
    """Looks from `eye` at `target` [m], y up."""

    eye: NDArray[np.float64]
    target: NDArray[np.float64]

    @classmethod
    def around(cls, low: NDArray, high: NDArray, azimuth: float, elevation: float, aspect: float) -> Camera:
        """Returns a camera that has the whole box in view, from these angles [degrees]; azimuth 0 looks along -z.

        aspect: width over height of the picture
        """
        middle, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
        a, e = np.radians(azimuth), np.radians(elevation)
        towards = np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])
        return cls(middle + towards * radius / np.tan(VIEW / 2) / min(1.0, aspect), middle)

    def seen(self, x: NDArray, width: int, height: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns places in the picture (..., 2) [pixels] and distances along the line of sight (...) [m]."""
        forward = self.target - self.eye
        forward = forward / np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        away = x - self.eye
        depth = away @ forward
        scale = height / 2 / np.tan(VIEW / 2) / np.maximum(depth, 1e-6)
        across = np.stack([away @ right * scale + width / 2, height / 2 - away @ np.cross(right, forward) * scale], -1)
        return across, depth


@dataclass(frozen=True)
class Piece:
    """A surface: vertices (n, 3) [m], triangles (t, 3) with normals outward, colour (3,) of all or (t, 3) of each."""

    x: NDArray
    triangles: NDArray
    color: NDArray


def paint(pieces: Sequence[Piece], camera: Camera, size: tuple[int, int], floor: float | None = None) -> Image:
    """Returns a picture of `size` [pixels]; floor: height of the plane that takes the shadow [m]. Raises ClientError
    without Pillow."""
    try:
        from PIL import Image, ImageDraw, ImageFilter
    except ImportError:
        raise ClientError(f"Pillow is not installed, of the extra view: {to_install('view')}") from None
    width, height = FINER * size[0], FINER * size[1]
    image = Image.new("RGB", (width, height), SKY)
    if floor is not None:
        image.paste(_backdrop(camera, floor, width, height))
        mask = Image.new("L", size, 0)
        draw = ImageDraw.Draw(mask)
        for piece in pieces:
            fallen = piece.x - np.outer((piece.x[:, 1] - floor) / LIGHT[1], LIGHT)
            corners = camera.seen(fallen, *size)[0][piece.triangles]
            for flat in corners[_turn(corners) < 0].reshape(-1, 6).tolist():  # those that face the light
                draw.polygon(flat, fill=150, outline=150)
        mask = mask.filter(ImageFilter.GaussianBlur(size[1] / 100)).resize((width, height))
        image.paste(SHADOW, mask=mask)
    draw = ImageDraw.Draw(image)
    corners, colors = _in_order(pieces, camera, width, height)
    for flat, color in zip(corners.reshape(-1, 6).tolist(), colors.tolist(), strict=True):
        draw.polygon(flat, fill=tuple(color), outline=tuple(color))
    return image.resize(size, Image.Resampling.LANCZOS)


def _in_order(pieces: Sequence[Piece], camera: Camera, width: int, height: int) -> tuple[NDArray, NDArray]:
    """Returns the triangles that face the camera, from far to near (t, 3, 2) [pixels], and their colours (t, 3)."""
    corners, depths, colors = [], [], []
    for piece in pieces:
        place, depth = camera.seen(piece.x, width, height)
        p = place[piece.triangles]
        front = (_turn(p) < 0) & (depth[piece.triangles] > 0).all(axis=1)
        corners.append(p[front])
        depths.append(depth[piece.triangles].mean(axis=1)[front])
        colors.append(_lit(piece, camera)[front])
    order = np.argsort(-np.concatenate(depths))
    return np.concatenate(corners)[order], np.concatenate(colors)[order]


def _turn(corners: NDArray) -> NDArray[np.float64]:
    """Returns twice the signed areas of triangles (t, 3, 2) in a picture; negative: seen from outside."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area: NDArray[np.float64] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return area


def _lit(piece: Piece, camera: Camera) -> NDArray[np.uint8]:
    """Returns the colours of triangles by the mean of their corners' normals (Blinn 1977)."""
    x, t = np.asarray(piece.x, float), piece.triangles
    faces = np.cross(x[t[:, 1]] - x[t[:, 0]], x[t[:, 2]] - x[t[:, 0]])
    nodes = np.zeros_like(x)
    for k in range(3):
        np.add.at(nodes, t[:, k], faces)
    normal = nodes[t].sum(axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True) + 1e-300
    towards = camera.eye - x[t].mean(axis=1)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    half = towards + LIGHT
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    diffuse = AMBIENT + (1 - AMBIENT) * (0.5 + 0.5 * normal @ LIGHT) ** 1.5
    bright = SHINE * np.clip((normal * half).sum(axis=1), 0, 1) ** 24
    color = np.broadcast_to(np.asarray(piece.color, float), (len(t), 3)) * diffuse[:, None] + 255 * bright[:, None]
    return np.clip(color, 0, 255).astype(np.uint8)


def _backdrop(camera: Camera, floor: float, width: int, height: int) -> Image:
    """Returns the floor, which fades into the background with distance."""
    from PIL import Image

    forward = camera.target - camera.eye
    reach = float(np.linalg.norm(forward))
    forward = forward / reach
    up = np.cross(np.cross(forward, [0.0, 1.0, 0.0]), forward)
    up /= np.linalg.norm(up)
    rows = (1 - 2 * (np.arange(height) + 0.5) / height) * np.tan(VIEW / 2)
    down = forward[1] + rows * up[1]
    distance = np.where(down < 0, (floor - camera.eye[1]) / np.minimum(down, -1e-9), np.inf)
    near = np.exp(-np.maximum(distance / reach - 0.6, 0) * 1.2)[:, None]
    shade = np.asarray(FLOOR) * near + np.asarray(SKY) * (1 - near)
    return Image.fromarray(np.repeat(shade[:, None].astype(np.uint8), width, axis=1))


def ball(centre: NDArray, radius: float, color: Sequence[float], detail: int = 10) -> Piece:
    """Returns a sphere."""
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, 2 * detail + 1), np.linspace(0, np.pi, detail + 1))
    x = np.stack([np.sin(v) * np.cos(u), np.cos(v), np.sin(v) * np.sin(u)], axis=-1).reshape(-1, 3)
    return Piece(np.asarray(centre) + radius * x, _grid(detail, 2 * detail), np.array(color, float))


def rod(a: NDArray, b: NDArray, radius: float, color: Sequence[float], detail: int = 8) -> Piece:
    """Returns a cylinder without ends from a to b."""
    along = np.subtract(b, a)
    side = np.cross(along, np.eye(3)[np.abs(along).argmin()])
    side = side / max(float(np.linalg.norm(side)), 1e-12)
    other = np.cross(along, side) / max(float(np.linalg.norm(along)), 1e-12)
    angle = np.linspace(0, 2 * np.pi, detail + 1)[:, None]
    ring = radius * (np.cos(angle) * side + np.sin(angle) * other)
    return Piece(np.concatenate([a + ring, b + ring]), _grid(1, detail), np.array(color, float))


def _grid(rows: int, columns: int) -> NDArray[np.int64]:
    i, j = (a.ravel() for a in np.mgrid[:rows, :columns])
    a = i * (columns + 1) + j
    b = a + columns + 1
    return np.concatenate([np.stack([a, a + 1, b], 1), np.stack([a + 1, b + 1, b], 1)])
