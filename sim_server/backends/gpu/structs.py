# SPDX-License-Identifier: MIT
"""Memory that the native GPU loop (loop.h) and Python share, as ctypes and NumPy see it.

mailbox.library compares the sizes of both sides when it loads the loop.
"""

import ctypes as c

import numpy as np

from sim_server.backends.cpu.structs import Rings
from sim_server.backends.declarations import Declarations

TEXT = Declarations("backends/gpu/loop.h")
p, i64 = c.c_void_p, c.c_int64
REQUEST_VALUES, REQUEST_POSITIONS = 1, 2  # of a BodyReadback
STEP_BATCHES, FRAME_COPIES = 2, 4  # largest numbers of batches and of frames under way
STEP_TIMESTAMP = np.dtype([("begin", "i8"), ("end", "i8")])
ENERGY_RECORD = np.dtype(
    [(n, "f8") for n in ("kinetic", "elastic", "gravity", "work", "budget", "stride")]
    + [("phase", "i4"), ("found", "i4")]
)
NEWTON_RESULT = np.dtype([("nonlinear", "f8"), ("linearizations", "i4"), ("unused", "i4")])


class CudaDriver(c.Structure):
    """Addresses of functions of the CUDA driver API."""

    _fields_ = [
        (name, p)
        for name in (
            "context_set", "graph_launch", "to_device", "to_host", "on_device", "event_record", "event_query",
            "event_wait", "stream_wait",
        )
    ]  # fmt: skip


class Mail(c.Structure):
    """New bytes for a mail slot."""

    _fields_ = [("bytes", p), ("event", p), ("number", i64), ("taken", i64)]


class MailSlot(c.Structure):
    """Bytes on the device that are replaced between batches."""

    _fields_ = [("target", c.c_uint64), ("size", i64), ("posted", p), ("pending", p), ("taken", i64)]


class BodyReadback(c.Structure):
    """Copies of the matrix or the positions of a body to the host."""

    _fields_ = [
        ("values_begin", i64), ("values_bytes", i64), ("x_begin", i64), ("x_bytes", i64), ("requested", c.c_int32),
        ("in_flight", c.c_int32), ("copied_step", i64),
    ]  # fmt: skip


class StepBatch(c.Structure):
    """Steps whose results are read together."""

    _fields_ = [
        ("upload", p), ("done", p), ("first", i64), ("steps", i64), ("late", c.c_double),
    ]  # fmt: skip


class FrameCopy(c.Structure):
    """Events of a frame under way: copied on the device, copied to the host."""

    _fields_ = [("taken", p), ("arrived", p)]


class GpuLoop(c.Structure):
    """State of the native loop."""

    _anonymous_ = ("rings",)
    _fields_ = [
        ("driver", c.POINTER(CudaDriver)), ("context", p), ("stream", p), ("copy_stream", p), ("graphs", p * 4),
        ("many", i64), ("mail_slots", c.POINTER(MailSlot)), ("readbacks", c.POINTER(BodyReadback)),
        ("mail_slot_count", c.c_int32), ("bodies", c.c_int32), ("results", p), ("timestamps", p),
        ("newton_results", p), ("energy_records", p), ("energy_balance", p), ("elastic_energy", p), ("capacity", i64),
        ("batch", i64), ("values", c.c_uint64), ("staged", c.c_uint64), ("host_matrices", p), ("staged_event", p),
        ("copied_event", p), ("x", c.c_uint64), ("v", c.c_uint64), ("frame_staging", c.c_uint64), ("frame_bytes", i64),
        ("clock", p), ("batch_seconds", c.c_double), ("poll", c.c_double), ("step_seconds", c.c_double),
        ("idle_since", c.c_double), ("cpu", c.c_double), ("begun", i64), ("finished", i64), ("launched", i64),
        ("frames_begun", i64), ("matrix_step", i64), ("requested", c.c_int32), ("ran_dry", c.c_int32),
        ("error", c.c_int32), ("failed_call", c.c_char * 28), ("batches", StepBatch * STEP_BATCHES),
        ("frame_copies", FrameCopy * FRAME_COPIES), ("rings", Rings),
    ]  # fmt: skip
