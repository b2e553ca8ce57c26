# SPDX-License-Identifier: MIT
"""Whether compiled kernels may be loaded from a folder: not if somebody else could have put them there.

A library that is loaded runs as part of this process. So it, its folder, and the folders above must belong to this user
or root, and nobody else may write to them; above, sticky folders such as /tmp are as good.
"""

import os
import stat
from pathlib import Path

OTHERS = stat.S_IWGRP | stat.S_IWOTH
HELP = "WARPFACTOR_CACHE names another folder"


def distrust(library: Path) -> str:
    """Returns why a library is not to be loaded, or made and loaded, from where it is; empty if it is."""
    if not hasattr(os, "geteuid"):  # Windows
        return ""
    folder = library.parent.resolve()
    if library.is_symlink() or (library.exists() and not library.is_file()):
        return f"{library} is no plain file; remove it"
    for path in (library, folder):
        if path.exists() and (why := _of(path, sticky=False)):
            return why
    return next((why for parent in folder.parents if (why := _of(parent, sticky=True))), "")


def _of(path: Path, sticky: bool) -> str:
    """sticky: it suffices that nobody may replace what others have in it"""
    found = path.stat()
    if found.st_uid not in (os.geteuid(), 0):
        return f"{path} belongs to user {found.st_uid}, this process to user {os.geteuid()}; {HELP}"
    writable = found.st_mode & OTHERS
    if writable & stat.S_IWGRP and alone_in(found.st_gid):
        writable &= ~stat.S_IWGRP
    if not writable or (sticky and found.st_mode & stat.S_ISVTX):
        return ""
    return f"{path} may be written by others (mode {stat.S_IMODE(found.st_mode):o}): chmod go-w {path}, or {HELP}"


def alone_in(group: int) -> bool:
    """True for a group of this user alone, as Debian makes one for each user, or that of root."""
    import grp
    import pwd

    try:
        user, entry = pwd.getpwuid(os.geteuid()), grp.getgrgid(group)
    except KeyError:
        return False
    return group == user.pw_gid and entry.gr_name == user.pw_name and set(entry.gr_mem) <= {user.pw_name}
