# SPDX-License-Identifier: MIT
"""The native loop, compiled and loaded."""

import ctypes as c
from functools import cache

from sim_server.backends.compiler import native
from sim_server.backends.cpu import structs


@cache
def loop_library() -> c.CDLL:
    """Compiles and loads the loop (native/loop.cpp), with the types of its functions."""
    loop, p = c.POINTER(structs.Loop), c.c_void_p
    library = native(
        "backends/cpu/native/loop.cpp",
        {
            "wf_assemble": (None, [loop]), "wf_solve": (None, [loop]), "wf_run": (c.c_int64, [loop, c.c_int64]),
            "wf_wait": (c.c_int32, [loop]), "wf_restart": (None, [loop, c.c_void_p, c.c_int32]),
            "wf_copy_matrix": (None, [loop, c.c_int32, p]), "wf_note_matrix": (None, [loop, c.c_int32]),
            "wf_post_factor": (p, [c.POINTER(structs.Body), p]), "wf_post_binding": (p, [c.POINTER(structs.Launch), p]),
            "wf_post_changes": (p, [loop, p]), "wf_take_changes": (None, [loop]),
            "wf_apply_factor": (None, [c.POINTER(structs.Factor), p, p, p, c.c_int32]),
            "wf_plan": (p, [c.POINTER(structs.Pattern), c.c_int32]), "wf_delete_plan": (None, [p]),
            "wf_precondition": (None, [loop, c.c_int32, p, p, p]),
        },
    )  # fmt: skip
    structs.LOOP.check_sizes(library)
    return library
