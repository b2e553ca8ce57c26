# SPDX-License-Identifier: MIT
"""An image of a run by matplotlib, for machines without a Vulkan driver: last frames and curves."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clients.errors import ClientError
from clients.log.reader import Log
from clients.viewer.colors import colors
from clients.viewer.obstacle_surface import COLOR, obstacle_surface
from clients.viewer.surface import Coloring, Surface, legend
from protocol.process.extras import to_install

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LIGHT = np.array([0.4, 0.8, 0.45])


def draw(log: Log, coloring: Coloring, top: float) -> bytes:
    """Draws a PNG of 1280 x 800: bodies at their last frame in the colours of the viewer, and four curves."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise ClientError(f"matplotlib is not installed, of the extra view: {to_install('view')}") from None
    figure = Figure(figsize=(12.8, 8), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(4, 2, width_ratios=[3, 2])
    _draw_bodies(figure.add_subplot(grid[:, 0], projection="3d"), log, coloring, top)
    _draw_curves(figure, grid, log)
    buffer = BytesIO()
    figure.savefig(buffer, format="png")
    return buffer.getvalue()


def _draw_bodies(axes: Any, log: Log, coloring: Coloring, top: float) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection  # type: ignore[import-untyped]

    low, high, last = np.full(3, np.inf), np.full(3, -np.inf), 0.0
    for name, found in log.objects.items():
        if not found.frames:
            continue
        frame = log.frame(name, -1)
        if not np.isfinite(frame.x).all():
            continue
        surface = Surface(log.mesh(name, frame.epoch), coloring)
        points = surface.points(frame.x)
        shade = 0.6 + 0.4 * np.abs(surface.normals(points) @ (LIGHT / np.linalg.norm(LIGHT)))
        rgba = colors(surface.values(frame.x), top) / 255
        rgba[:, :3] *= shade[:, None]
        faces = rgba[surface.triangles].mean(axis=1)
        triangles = _upright(points[surface.triangles])
        axes.add_collection3d(Poly3DCollection(triangles, facecolors=faces, edgecolors="none"))
        low, high = np.minimum(low, points.min(axis=0)), np.maximum(high, points.max(axis=0))
        last = max(last, frame.time)
    if np.isfinite(low).all():
        for obstacle in log.obstacles.values():
            vertices, drawn = obstacle_surface(obstacle, low, high)
            if not len(drawn):
                continue
            pose = log.poses[obstacle.name][-1].pose if obstacle.name in log.poses else obstacle.start
            triangles = _upright((vertices @ pose.matrix().T + pose.position)[drawn])
            axes.add_collection3d(Poly3DCollection(triangles, facecolors=np.array(COLOR) / 255, alpha=0.3))
        low, high = np.sort(_upright(np.array([low, high])), axis=0)
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        axes.set_box_aspect(np.maximum(high - low, 1e-3 * (high - low).max() + 1e-12))
    axes.set(xlabel="x [m]", ylabel="-z [m]", zlabel="y [m]")
    axes.set_title(f"t = {last:.3g} s, {legend(coloring, top)}")


def _upright(points: NDArray) -> NDArray:
    """Returns points (..., 3) with y turned up, as matplotlib has z."""
    return points[..., [0, 2, 1]] * [1, -1, 1]


def _draw_curves(figure: Figure, grid: Any, log: Log) -> None:
    titles = ("PCG iterations", "true residual", "factor age [steps]", "step time [ms]")
    plots = [figure.add_subplot(grid[k, 1]) for k in range(4)]
    for number, name in enumerate(sorted(log.objects)):
        scalars = log.scalars(name)
        time, age = scalars["time"], scalars["factor_age"]
        plots[0].plot(time, scalars["iterations"], label=name)
        plots[1].plot(time, np.maximum(scalars["residual"], 1e-17))
        plots[2].plot(time, np.where(age >= 0, age, np.nan))
        if number == 0:
            plots[3].plot(time, scalars["step_seconds"] * 1e3)
    for plot, title in zip(plots, titles, strict=True):
        plot.set_title(title, fontsize="small")
    plots[1].set_yscale("log")
    plots[3].set_xlabel("simulated time [s]")
    if 0 < len(log.objects) <= 8:
        plots[0].legend(fontsize="small")
