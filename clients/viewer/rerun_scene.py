# SPDX-License-Identifier: MIT
"""Meshes and scalars of a run as rerun entities.

/world/OBJECT holds the surface, /world/OBSTACLE too, /plots/QUANTITY/OBJECT a curve, /plots/energy/KIND/OBJECT and
/plots/estimate/KIND/OBJECT curves of energies and estimated errors, /plots/reading/QUANTITY/WHAT of OBJECT curves of
what effects tell, as the pressure of a cavity, /events/OBJECT what went wrong; timelines are `step` and `time`
(simulated).
"""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from clients.log.events import Events
from clients.log.frames import Frame, Mesh
from clients.log.obstacles import Obstacle, ObstacleFrame, Pose
from clients.log.scalars import REACTION, READING, Columns
from clients.viewer.colors import colors
from clients.viewer.obstacle_surface import COLOR, obstacle_surface
from clients.viewer.surface import Coloring, Surface, legend

PLOTS = {  # entity below /plots -> title
    "iterations": "PCG iterations",
    "residual": "true residual, log10",
    "factor_age": "factor age [steps]",
    "estimate": "estimated errors of a step, log10 m",
    "step_time": "step time [ms]",
    "energy": "energy [J]",
}
CONTACT_PLOTS = {  # of runs with contact
    "contacts": "places in contact",
    "contact_residual": "contact residual, log10",
    "reaction": "force on obstacles, objects and hands [N]",
}
ERRORS = {"solve_error": "linear_solve", "step_error": "equation", "estimate": "time_step"}  # column -> entity
ENERGIES = ("kinetic_energy", "elastic_energy", "gravity_energy", "work", "dissipated")


class RerunScene:
    """Logs frames and steps to a recording. `top`: value of the last colour; with `grow` it follows the data."""

    def __init__(self, recording: rr.RecordingStream, coloring: Coloring, top: float = 0.0, grow: bool = False) -> None:
        self._recording = recording
        self._coloring: Coloring = coloring
        self._surfaces: dict[str, tuple[int, Surface]] = {}  # object -> epoch and surface of the newest one
        self._shown: dict[str, int] = {}  # object -> epoch whose triangles were logged last
        self._top, self._grow = top, grow
        self._has_contact = False
        self._quantities: dict[str, None] = {}  # of readings
        self._events: dict[str, Events] = {}
        self._low = np.full(3, np.inf)
        self._high = np.full(3, -np.inf)
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_UP, static=True)
        self._log_legend()

    def surface(self, mesh: Mesh) -> Surface:
        """Returns the surface of a mesh, made when the mesh of its object changes."""
        epoch, surface = self._surfaces.get(mesh.object, (-1, None))
        if surface is None or epoch != mesh.epoch:
            surface = Surface(mesh, self._coloring)
            self._surfaces[mesh.object] = mesh.epoch, surface
        return surface

    @property
    def quantities(self) -> int:
        """Number of the quantities that effects have told so far, each with a plot of its own."""
        return len(self._quantities)

    def frame(self, frame: Frame, mesh: Mesh) -> bool:
        """Logs positions, normals and colours, and new triangles. Returns False for NaN, which is not shown."""
        if not np.isfinite(frame.x).all():
            return False
        surface = self.surface(mesh)
        if not len(surface.nodes):
            return True
        points, values = surface.points(frame.x), surface.values(frame.x)
        self._extend(points, values)
        self._recording.set_time("step", sequence=frame.step)
        self._recording.set_time("time", duration=frame.time)
        triangles = surface.triangles if self._shown.get(frame.object) != frame.epoch else None
        self._shown[frame.object] = frame.epoch
        shape = rr.Mesh3D.from_fields(
            vertex_positions=points,
            vertex_normals=surface.normals(points),
            vertex_colors=colors(values, self._top),
            triangle_indices=triangles,
        )
        self._recording.log(_entity("world", frame.object), shape)
        return True

    def obstacle(self, obstacle: Obstacle) -> None:
        """Logs the shape of an obstacle and where it is at the start; a plane as large as the bodies logged so far."""
        self._has_contact, known = True, np.isfinite(self._low).all()
        low, high = (self._low, self._high) if known else (np.zeros(3), np.ones(3))
        vertices, triangles = obstacle_surface(obstacle, low, high)
        shape = rr.Mesh3D(vertex_positions=vertices, triangle_indices=triangles, albedo_factor=COLOR)
        entity, start = _entity("world", obstacle.name), _transform(obstacle.start)
        if len(vertices):
            self._recording.log(entity, shape, static=True)
        if obstacle.moved:
            self._recording.set_time("step", sequence=0)
            self._recording.set_time("time", duration=0.0)
        self._recording.log(entity, start, static=not obstacle.moved)

    def pose(self, frame: ObstacleFrame) -> None:
        """Logs where an obstacle is after a step."""
        self._recording.set_time("step", sequence=frame.step)
        self._recording.set_time("time", duration=frame.time)
        self._recording.log(_entity("world", frame.obstacle), _transform(frame.pose))

    def steps(self, name: str, scalars: Columns, step_time: bool) -> None:
        """Logs scalars per step (k,) as curves. step_time: also the step time, which all objects share."""
        age = scalars["factor_age"]
        with np.errstate(divide="ignore", invalid="ignore"):
            residual = np.log10(np.maximum(scalars["residual"], 1e-17))
        self._curve("iterations", name, scalars, scalars["iterations"], np.ones(len(age), bool))
        self._curve("residual", name, scalars, residual, np.isfinite(residual))
        self._curve("factor_age", name, scalars, age, age >= 0)
        for column, kind in ERRORS.items():
            with np.errstate(divide="ignore", invalid="ignore"):
                error = np.log10(scalars[column])
            self._curve(f"estimate/{kind}", name, scalars, error, np.isfinite(error))
        for energy in ENERGIES:
            values = scalars[energy]
            self._curve(f"energy/{energy.removesuffix('_energy')}", name, scalars, values, np.isfinite(values))
        self._contact(name, scalars)
        for column in (each for each in scalars if each.startswith(READING)):
            of, quantity = column.removeprefix(READING).rsplit("/", 1)
            self._quantities[quantity] = None
            known = np.isfinite(scalars[column])
            self._curve(f"reading/{quantity}", f"{of} of {name}", scalars, scalars[column], known)
        self._tell(name, scalars)
        if step_time:
            self._curve("step_time", "all", scalars, scalars["step_seconds"] * 1e3, np.ones(len(age), bool))

    def blueprint(self) -> rrb.Blueprint:
        """Returns the layout: bodies on the left, all in view, and a plot per quantity on the right."""
        center, reach = np.zeros(3), 1.0
        if np.isfinite(self._low).all():
            center = (self._low + self._high) / 2
            reach = float(np.linalg.norm(self._high - self._low)) or 1.0
        eye = rrb.EyeControls3D(
            position=center + reach * np.array([0.35, 0.35, 1.1]), look_target=center, eye_up=(0.0, 1.0, 0.0)
        )
        bodies = rrb.Vertical(
            rrb.Spatial3DView(origin="/world", name="bodies", eye_controls=eye),
            rrb.TextDocumentView(origin="/legend", name="colour"),
            rrb.TextLogView(origin="/events", name="what went wrong"),
            row_shares=[8, 1, 1],
        )
        plotted = PLOTS | CONTACT_PLOTS if self._has_contact else PLOTS
        plotted = plotted | {f"reading/{quantity}": f"{quantity} [SI unit]" for quantity in self._quantities}
        plots = rrb.Vertical(
            *(rrb.TimeSeriesView(origin=f"/plots/{quantity}", name=title) for quantity, title in plotted.items())
        )
        return rrb.Blueprint(
            rrb.Horizontal(bodies, plots, column_shares=[3, 2]),
            rrb.TopPanel(state="hidden"),
            rrb.BlueprintPanel(state="hidden"),
            rrb.SelectionPanel(state="hidden"),
            rrb.TimePanel(state="collapsed", timeline="time"),
            auto_views=False,
        )

    def _tell(self, name: str, scalars: Columns) -> None:
        """Logs a line at each step in which what goes wrong changes."""
        for event in self._events.setdefault(name, Events()).changes(scalars):
            self._recording.set_time("step", sequence=event.step)
            self._recording.set_time("time", duration=event.time)
            level = rr.TextLogLevel.WARN if event.wrong else rr.TextLogLevel.INFO
            self._recording.log(_entity("events", name), rr.TextLog(event.text, level=level))

    def _contact(self, name: str, scalars: Columns) -> None:
        """Logs what a run with obstacles has beside the others."""
        if not self._has_contact:
            return
        known = np.isfinite(scalars["contact_residual"])
        residual = np.log10(np.maximum(scalars["contact_residual"], 1e-17))
        self._curve("contact_residual", name, scalars, residual, known)
        every = np.ones(len(known), bool)
        self._curve("contacts", name, scalars, scalars["contacts"], every)
        for column in scalars:
            if column.startswith(REACTION) and column.endswith("/force_x"):
                pair = column.removesuffix("/force_x")
                force = np.linalg.norm([scalars[f"{pair}/force_{axis}"] for axis in "xyz"], axis=0)
                self._curve("reaction", f"{name} on {pair.removeprefix(REACTION)}", scalars, force, every)

    def _extend(self, points: NDArray, values: NDArray) -> None:
        self._low, self._high = np.minimum(self._low, points.min(axis=0)), np.maximum(self._high, points.max(axis=0))
        if self._grow and values.max() > self._top:
            self._top = float(values.max())
            self._log_legend()

    def _log_legend(self) -> None:
        self._recording.log("legend", rr.TextDocument(legend(self._coloring, self._top)), static=True)

    def _curve(self, quantity: str, name: str, scalars: Columns, values: NDArray, used: NDArray) -> None:
        if used.any():
            self._recording.send_columns(
                _entity(f"plots/{quantity}", name),
                [
                    rr.TimeColumn("step", sequence=scalars["step"][used]),
                    rr.TimeColumn("time", duration=scalars["time"][used]),
                ],
                rr.Scalars.columns(scalars=values[used].astype(np.float64)),
            )


def _transform(pose: Pose) -> rr.Transform3D:
    w, x, y, z = pose.rotation
    return rr.Transform3D(translation=pose.position, quaternion=rr.Quaternion(xyzw=[x, y, z, w]))


def _entity(parent: str, name: str) -> str:
    return f"{parent}/{rr.escape_entity_path_part(name)}"
