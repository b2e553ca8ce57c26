# SPDX-License-Identifier: MIT
"""Memory that the native GPU loop and Python share. The C++ side is loop.h; sizes are compared when it is loaded."""

import ctypes as c

import numpy as np

from sim_server.backends.cpu.structs import Rings

p, i64 = c.c_void_p, c.c_int64
DEPTH, PICTURES = 2, 4  # batches and frames under way at most
STAMP = np.dtype([("begin", "i8"), ("end", "i8")])
ENERGY = np.dtype(
    [(n, "f8") for n in ("kinetic", "elastic", "gravity", "work", "budget", "stride")]
    + [("phase", "i4"), ("found", "i4")]
)
FOUND = np.dtype([("nonlinear", "f8"), ("linearizations", "i4"), ("unused", "i4")])


class Cuda(c.Structure):
    """Addresses of functions of the driver API."""

    _fields_ = [
        (name, p)
        for name in (
            "context_set", "graph_launch", "to_device", "to_host", "on_device", "event_record", "event_query",
            "event_wait", "stream_wait",
        )
    ]  # fmt: skip


class Mail(c.Structure):
    _fields_ = [("bytes", p), ("event", p), ("number", i64), ("taken", i64)]


class Mailbox(c.Structure):
    _fields_ = [("target", c.c_uint64), ("size", i64), ("mail", p), ("held", p), ("taken", i64)]


class Body(c.Structure):
    _fields_ = [
        ("begin", i64), ("bytes", i64), ("place", i64), ("size", i64), ("wanted", c.c_int32), ("coming", c.c_int32),
        ("copied", i64),
    ]  # fmt: skip


class Batch(c.Structure):
    _fields_ = [
        ("upload", p), ("done", p), ("first", i64), ("steps", i64), ("late", c.c_double),
    ]  # fmt: skip


class Picture(c.Structure):
    _fields_ = [("taken", p), ("arrived", p)]


class Loop(c.Structure):
    _anonymous_ = ("rings",)
    _fields_ = [
        ("cuda", c.POINTER(Cuda)), ("context", p), ("stream", p), ("copies", p), ("graphs", p * 4), ("many", i64),
         ("mailbox", c.POINTER(Mailbox)), ("body", c.POINTER(Body)),
        ("mailboxes", c.c_int32), ("bodies", c.c_int32), ("results", p), ("stamps", p),
        ("found", p), ("energies", p), ("account", p), ("elastic", p), ("capacity", i64), ("batch", i64),
        ("values", c.c_uint64), ("staged", c.c_uint64),
        ("matrices", p), ("snapped", p), ("home", p), ("x", c.c_uint64), ("v", c.c_uint64), ("pictures", c.c_uint64),
        ("frame_bytes", i64), ("clock", p), ("span", c.c_double), ("poll", c.c_double), ("step_seconds", c.c_double),
        ("idle", c.c_double), ("cpu", c.c_double), ("begun", i64), ("finished", i64), ("launched", i64),
        ("drawn", i64), ("matrix_step", i64), ("asked", c.c_int32), ("stalled", c.c_int32), ("error", c.c_int32),
        ("where", c.c_char * 28),
        ("batches", Batch * DEPTH), ("picture", Picture * PICTURES), ("rings", Rings),
    ]  # fmt: skip
