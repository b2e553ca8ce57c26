# SPDX-License-Identifier: MIT
"""Asks the server's program for a scene as it is with defaults and overrides, which clients know nothing of."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from clients.errors import BadInput, ClientError


def digest(scene: Path, overrides: Sequence[str] = ()) -> str:
    """Returns a digest of the scene as resolved. Raises BadInput if it cannot be read."""
    command = [sys.executable, "-m", "sim_server.scene", str(scene), *overrides]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode == 2:
        raise BadInput(done.stderr.strip())
    if done.returncode:
        raise ClientError(f"{scene}: cannot be read: {done.stderr.strip()[-500:]}")
    return hashlib.sha256(done.stdout.strip().encode()).hexdigest()
