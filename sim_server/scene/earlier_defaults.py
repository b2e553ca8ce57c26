# SPDX-License-Identifier: MIT
"""Values that keys had by default in earlier versions, whose logs and checkpoints hold scenes without these keys."""

from typing import Any

SPLIT = "kuhn"  # of a bar; since it is "mirrored", resolved scenes name it
ELEMENTS = "linear"  # there were no others; since there are, resolved scenes have the key


def named(resolved: Any) -> Any:
    """Returns a resolved scene of any version with the defaults of its version written out; it is not changed."""
    if not isinstance(resolved, dict) or not isinstance(resolved.get("object"), list):
        return resolved
    return {**resolved, "object": [_with_defaults(each) for each in resolved["object"]]}


def _with_defaults(table: Any) -> Any:
    mesh = table.get("mesh") if isinstance(table, dict) else None
    if not isinstance(mesh, dict):
        return table
    split = {"split": SPLIT} if "bar" in mesh else {}
    return {"elements": ELEMENTS, **table, "mesh": {**split, **mesh}}
