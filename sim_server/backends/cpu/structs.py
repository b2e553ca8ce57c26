# SPDX-License-Identifier: MIT
"""Memory that the native loop and Python share, as ctypes and NumPy see it.

The C++ side is native/ring_buffers.h and native/loop.h; sizes are compared when a library is loaded.
"""

import ctypes as c

import numpy as np

RECORD = np.dtype(
    [
        ("step", "i8"), ("factor_step", "i8"), ("time", "f8"), ("residual", "f8"), ("assemble", "f8"), ("solve", "f8"),
        ("integrate", "f8"), ("whole", "f8"), ("late", "f8"), ("begin", "f8"), ("cpu", "f8"), ("nonlinear", "f8"),
        ("kinetic", "f8"), ("elastic", "f8"), ("gravity", "f8"), ("work", "f8"), ("budget", "f8"), ("stride", "f8"),
        ("body", "i4"), ("iterations", "i4"), ("status", "i4"), ("kind", "i4"), ("asked", "i4"), ("fallbacks", "i4"),
        ("bad_node", "i4"), ("probe", "i4"), ("linearizations", "i4"), ("unused", "i4"),
    ]
)  # fmt: skip
"""One body, one step: what a loop reports. Seconds, except step numbers; `step` counts completed steps.

kinetic, elastic, gravity, work and budget [J], stride [m]: kernels/energy_balance.cuh. elastic: NaN unless wanted.
On a GPU only the solve is timed apart: assemble and integrate are 0 there. whole is the step's time on the device.
"""


class Rings(c.Structure):
    """Records, frames, pace, stop and pause: the same for both devices."""

    _fields_ = [
        ("dt", c.c_double), ("start_time", c.c_double), ("step", c.c_int64), ("records", c.c_void_p),
        ("record_capacity", c.c_int64), ("record_head", c.c_int64), ("record_tail", c.c_int64), ("frames", c.c_void_p),
        ("frame_steps", c.c_void_p), ("frame_capacity", c.c_int64), ("frame_every", c.c_int64),
        ("energy_every", c.c_int64), ("frame_head", c.c_int64), ("frame_tail", c.c_int64),
        ("frames_dropped", c.c_int64),
        ("records_dropped", c.c_int64), ("late_steps", c.c_int64), ("realtime", c.c_int32), ("patient", c.c_int32),
        ("stop", c.c_int32), ("pause", c.c_int32), ("deadline", c.c_double), ("late", c.c_double),
    ]  # fmt: skip


class Pattern(c.Structure):
    _fields_ = [
        ("size", c.c_int32), ("supernodes", c.c_int32), ("permutation", c.c_void_p), ("super_start", c.c_void_p),
        ("row_start", c.c_void_p), ("rows", c.c_void_p), ("value_start", c.c_void_p),
    ]  # fmt: skip


class Factor(c.Structure):
    _fields_ = [
        ("pattern", c.POINTER(Pattern)), ("values", c.c_void_p), ("step", c.c_int64), ("bytes", c.c_int32),
        ("unused", c.c_int32),
    ]  # fmt: skip


class Settings(c.Structure):
    _fields_ = [
        ("tolerance", c.c_double), ("budget", c.c_double), ("max_iterations", c.c_int32), ("kind", c.c_int32),
        ("warm_start", c.c_int32), ("probe", c.c_int32), ("omega", c.c_double),
    ]  # fmt: skip


class Binding(c.Structure):
    _fields_ = [("params", c.c_void_p), ("items", c.c_int32), ("unused", c.c_int32), ("taken", c.c_int64)]


class Launch(c.Structure):
    _fields_ = [("kernel", c.c_void_p), ("binding", c.c_void_p), ("mail", c.c_void_p), ("parts", c.c_void_p)]


class Correction(c.Structure):
    _fields_ = [
        ("capacity", c.c_int32), ("history", c.c_int32), ("nodes", c.c_int32), ("count", c.c_int32),
        ("supernodes", c.c_int32), ("usable", c.c_int32), ("used", c.c_int32), ("unused", c.c_int32),
        ("changes", c.c_int64), ("forgotten", c.c_int64), ("step", c.c_int64), ("factor", c.c_void_p),
        ("diagonal", c.c_void_p), ("last", c.c_void_p), ("then", c.c_void_p), ("change", c.c_void_p),
        ("node", c.c_void_p), ("supernode", c.c_void_p), ("marked", c.c_void_p), ("delta", c.c_void_p),
        ("small", c.c_void_p), ("columns", c.c_void_p),
    ]  # fmt: skip


class Body(c.Structure):
    _fields_ = [
        ("first", c.c_int32), ("last", c.c_int32), ("settings", Settings), ("now", Settings), ("factor", c.c_void_p),
        ("mail", c.c_void_p), ("snapshot", c.c_void_p), ("snapshot_step", c.c_int64), ("ahead", c.c_double),
        ("steps", c.c_int64), ("correction", Correction),
    ]  # fmt: skip


class Search(c.Structure):
    _fields_ = [
        ("first", c.c_double), ("floor", c.c_double), ("last", c.c_double), ("slope", c.c_double),
        ("scale", c.c_double), ("norm", c.c_double), ("residual", c.c_double), ("seconds", c.c_double),
        ("phase", c.c_int32), ("linearizations", c.c_int32), ("tried", c.c_int32), ("iterations", c.c_int32),
        ("status", c.c_int32), ("kind", c.c_int32), ("fallbacks", c.c_int32), ("verdict", c.c_int32),
    ]  # fmt: skip


class Newton(c.Structure):
    _fields_ = [
        ("linearizations", c.c_int32), ("trials", c.c_int32), ("tolerance", c.c_double), ("dx_dv", c.c_double),
        ("rotation", c.c_void_p), ("mass", c.c_void_p), ("beta", c.c_void_p),
        ("predictor", c.c_void_p),
        ("damping_velocity", c.c_void_p), ("inertial_increment", c.c_void_p), ("room", c.c_void_p),
        ("search", c.POINTER(Search)),
    ]  # fmt: skip


class Elastic(c.Structure):
    _fields_ = [("launch", Launch), ("energy", c.c_void_p), ("parts", c.c_void_p)]


BALANCE = np.dtype(
    [
        *((n, "f8") for n in ("start", "mass", "diagonal", "floor", "limit")),
        *((n, "f8") for n in ("kinetic", "elastic", "gravity", "work", "budget", "fallen", "stride")),
        ("phase", "i4"), ("found", "i4"),
    ]
)  # fmt: skip


class Energies(c.Structure):
    _fields_ = [
        ("gravity", c.c_void_p), ("mass", c.c_void_p), ("before", c.c_void_p), ("force", c.c_void_p),
        ("spring", c.c_void_p), ("anchor", c.c_void_p), ("free", c.c_void_p), ("still", c.POINTER(c.c_void_p)),
        ("elastic", c.POINTER(Elastic)), ("balance", c.c_void_p), ("left", c.c_void_p),
        ("stills", c.c_int32), ("elastics", c.c_int32),
        ("on_runaway", c.c_int32), ("inertia", c.c_int32), ("begun", c.c_int32), ("unused", c.c_int32),
    ]  # fmt: skip


class Loop(c.Structure):
    _anonymous_ = ("rings",)
    _fields_ = [
        ("launches", c.c_int32), ("before", c.c_int32), ("launch", c.POINTER(Launch)), ("bodies", c.c_int32),
        ("nodes", c.c_int32), ("body", c.POINTER(Body)), ("row_start", c.c_void_p), ("columns", c.c_void_p),
        ("values", c.c_void_p), ("b", c.c_void_p), ("y", c.c_void_p), ("x", c.c_void_p), ("v", c.c_void_p),
        ("work", c.c_void_p), ("newton", c.POINTER(Newton)), ("clock", c.c_void_p), ("moving", c.c_void_p),
        ("energies", c.POINTER(Energies)), ("threads", c.c_int32), ("unused", c.c_int32),
        ("assemble_begin", c.c_double),
        ("assemble_seconds", c.c_double), ("cpu_begin", c.c_double), ("rings", Rings),
    ]  # fmt: skip


def check_sizes(name: str, theirs: list[int], ours: list[int]) -> None:
    """Raises RuntimeError if the C++ text `name` and this package disagree on a layout."""
    if theirs != ours:
        raise RuntimeError(f"{name} and Python disagree on layouts: {theirs} and {ours}")
