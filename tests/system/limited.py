# SPDX-License-Identifier: MIT
"""Run a script with a locked-memory limit of so many KiB and without the right to exceed it: limited.py KIB SCRIPT …"""

import ctypes
import resource
import runpy
import sys

CAP_IPC_LOCK = 14
VERSION_3 = 0x20080522


def drop_capability(number: int) -> None:
    """Take a capability out of the effective and permitted sets of this process."""
    libc = ctypes.CDLL(None, use_errno=True)
    header = (ctypes.c_uint32 * 2)(VERSION_3, 0)
    sets = (ctypes.c_uint32 * 6)()  # effective, permitted, inheritable of capabilities 0 to 31, then 32 to 63
    if libc.capget(header, sets) != 0:
        raise OSError(ctypes.get_errno(), "capget")
    for k in range(2):
        sets[k] &= ~(1 << number)
    if libc.capset(header, sets) != 0:
        raise OSError(ctypes.get_errno(), "capset")


if __name__ == "__main__":
    limit = int(sys.argv[1]) << 10
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (limit, limit))
    drop_capability(CAP_IPC_LOCK)
    sys.argv = sys.argv[2:]
    runpy.run_path(sys.argv[0], run_name="__main__")
