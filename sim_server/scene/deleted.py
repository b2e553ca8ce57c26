# SPDX-License-Identifier: MIT
"""Keys and values that scenes had in earlier versions, and what to write in their place."""

from typing import Any

KEYS = {
    "solver.recycle": "leave it out",
}
"""By key, as in a scene file: object.effects... for those of any object."""

VALUES = {
    ("solver.schedule", "oldest"): 'write "excess", the default, or "round_robin"',
    ("solver.schedule", "weighted"): 'write "excess", the default',
}


def advice(key: str, value: Any) -> str | None:
    """What a message says of a deleted key, or of a deleted value of a key that there still is; None for all others."""
    if key in KEYS:
        return f"no longer exists: {KEYS[key]}"
    if isinstance(value, str) and (key, value) in VALUES:
        return f"no longer exists: {VALUES[key, value]}"
    return None
