# SPDX-License-Identifier: MIT
"""Keys and values that scenes had in earlier versions, and what to write in their place."""

from typing import Any

KEYS = {
    "solver.recycle": "leave it out",
}
"""By key, as in a scene file: object.effects... for those of any object."""

WITHOUT_EFFECT = {
    "solver.recycle": 0,
}
"""Values of deleted keys with which a scene of an earlier version means the same as without the key."""

VALUES = {
    ("solver.schedule", "oldest"): 'write "excess", the default, or "round_robin"',
    ("solver.warp", "auto"): "write true, the default, or false",
    ("solver.schedule", "weighted"): 'write "excess", the default',
}


def advice(key: str, value: Any) -> str | None:
    """What a message says of a deleted key, or of a deleted value of a key that there still is; None for all others."""
    if key in KEYS:
        return f"no longer exists: {KEYS[key]}"
    if isinstance(value, str) and (key, value) in VALUES:
        return f"no longer exists: {VALUES[key, value]}"
    return None


def without(resolved: Any) -> Any:
    """The resolved scene of an earlier version, as logs hold it, without deleted keys that have no effect there."""
    for key, value in WITHOUT_EFFECT.items():
        table, name = key.rsplit(".", 1)
        place = resolved.get(table) if isinstance(resolved, dict) else None
        if isinstance(place, dict) and place.get(name) == value:
            del place[name]
    return resolved
