# SPDX-License-Identifier: MIT
"""Ends this process when the one that started it ends, however it ends."""

import ctypes
import os
import signal

PR_SET_PDEATHSIG = 1


def die_with_parent(parent: int | None = None) -> None:
    """Requests SIGTERM for the death of the parent (Linux: of the thread that started this process).

    parent: its process id, if that is known; otherwise a parent that died before the call is not noticed
    """
    if parent is None:
        parent = os.getppid()
    if ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != parent:  # it died before the request
        os.kill(os.getpid(), signal.SIGTERM)
