# SPDX-License-Identifier: MIT
"""Locks of logs, so that two servers never write to one.

A lock is that of flock(2): it goes with its process, however that ends. Over NFS it holds among all machines that mount
the folder, unless it is mounted with `nolock` or `local_lock`; on a file system without locks there is none.
"""

import errno
import fcntl
import os
import time
from pathlib import Path

TRIES, PAUSE = 5, 0.01  # s; another process may just look whether it is locked
UNSUPPORTED = (errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS)


def lock(descriptor: int) -> bool:
    """Locks an open file until all duplicates of the descriptor are closed; False if another process has locked it."""
    for _ in range(TRIES):
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        except BlockingIOError:
            time.sleep(PAUSE)
        except OSError as error:
            if error.errno in UNSUPPORTED:
                return True
            raise
    return False


def is_locked(path: Path) -> bool:
    """True if a process has locked a file, this one included; False if the file cannot be opened."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except OSError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    finally:
        os.close(descriptor)
    return False
