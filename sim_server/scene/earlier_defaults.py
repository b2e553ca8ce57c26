# SPDX-License-Identifier: MIT
"""Values that keys had by default in earlier versions, whose logs and checkpoints hold scenes without these keys."""

from typing import Any

SPLIT = "kuhn"  # of a bar; since it is "mirrored", resolved scenes name it


def named(resolved: Any) -> Any:
    """Returns a resolved scene of any version with the defaults of its version written out; it is not changed."""
    if not isinstance(resolved, dict) or not isinstance(resolved.get("object"), list):
        return resolved
    return {**resolved, "object": [_with_split(each) for each in resolved["object"]]}


def _with_split(table: Any) -> Any:
    mesh = table.get("mesh") if isinstance(table, dict) else None
    if not isinstance(mesh, dict) or "bar" not in mesh or "split" in mesh:
        return table
    return {**table, "mesh": {**mesh, "split": SPLIT}}
