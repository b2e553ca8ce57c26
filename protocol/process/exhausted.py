# SPDX-License-Identifier: MIT
"""Names the resource that a process has exhausted, in a sentence instead of a traceback."""

import errno

UNLOADED = ("failed to map segment", "cannot allocate memory")  # messages of the loader of libraries
FULL = (errno.ENOMEM, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EMFILE, errno.ENFILE, errno.EAGAIN)


def exhausted(error: BaseException) -> str:
    """Says which of memory, threads, files or disk was exhausted; "" if the error is another one."""
    if isinstance(error, MemoryError):
        return f"out of memory{f': {error}' if str(error) else ''}"
    if isinstance(error, ImportError) and any(words in str(error).lower() for words in UNLOADED):
        return f"out of memory: {error}"
    if isinstance(error, OSError) and error.errno in FULL:
        return f"{error.filename}: {error.strerror}" if error.filename else str(error.strerror)
    if isinstance(error, RuntimeError) and "start new thread" in str(error):
        return "no more threads can be started: memory or the number of threads is limited (ulimit -v, -u)"
    if type(error).__name__ == "PanicException":  # of a library in Rust, which does not export the class
        return f"zenoh cannot go on: {' '.join(str(error).split())[:300]}"
    return ""
