# SPDX-License-Identifier: MIT
"""What stands beside bodies in the scene of all tabs: obstacles, and the springs of grabs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from clients.log.obstacles import Obstacle, ObstacleFrame, Pose
from clients.viewer.obstacle_surface import COLOR, obstacle_surface
from clients.web.hand import Hand
from clients.web.surfaces import Float64, Surfaces

if TYPE_CHECKING:
    import viser

SPRING = (255, 90, 30)


class Obstacles:
    """Surfaces of obstacles, where they are. A holder is a group of nodes and has none: its frame is drawn."""

    def __init__(self, scene: viser.SceneApi, obstacles: Mapping[str, Obstacle], low: Float64, high: Float64) -> None:
        self._nodes: dict[str, Any] = {}
        size = float(np.linalg.norm(high - low)) or 1.0
        for name, obstacle in obstacles.items():
            where = f"/obstacles/{name}"
            if obstacle.shape == "holder":
                node: Any = scene.add_frame(where, axes_length=0.06 * size, axes_radius=0.004 * size)
            else:
                surface = obstacle_surface(obstacle, low, high)
                node = scene.add_mesh_simple(
                    where, surface.vertices, surface.triangles, color=COLOR[:3], side="double", flat_shading=True,
                    opacity=0.6 if obstacle.shape == "plane" else None, cast_shadow=False, receive_shadow=False,
                )  # fmt: skip
            self._nodes[name] = node
            _place(node, obstacle.start)

    def move(self, frames: Iterable[ObstacleFrame]) -> None:
        for frame in frames:
            if frame.obstacle in self._nodes:
                _place(self._nodes[frame.obstacle], frame.pose)

    def remove(self) -> None:
        for node in self._nodes.values():
            node.remove()


def _place(node: Any, pose: Pose) -> None:
    node.position, node.wxyz = pose.position, pose.rotation


class Springs:
    """A line and the force of each grab, seen in all tabs."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._nodes: dict[int, tuple[Any, Any]] = {}  # by the number of the hand: line, label

    def update(self, hands: Iterable[Hand], surfaces: Surfaces) -> None:
        """Draws what is held now."""
        held = {hand.number: hand for hand in hands if not hand.over}
        for number in set(self._nodes) - set(held):
            self._nodes.pop(number)[0].remove()  # and the label, which hangs on it
        for number, hand in held.items():
            begin = surfaces.points[hand.vertex]
            ends = np.array([[begin, hand.target]], np.float32)
            if number not in self._nodes:
                line = self._scene.add_line_segments(
                    f"/springs/{number}", ends, SPRING, thickness=3.0, thickness_units="screen"
                )
                label = self._scene.add_label(f"/springs/{number}/force", "", anchor="bottom-left")
                self._nodes[number] = line, label
            line, label = self._nodes[number]
            line.points = ends
            label.position = hand.target
            label.text = f"{hand.force:.3g} N"
