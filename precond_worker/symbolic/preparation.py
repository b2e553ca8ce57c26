# SPDX-License-Identifier: MIT
"""Which objects of a server a worker makes ready for before their first matrices come."""

import json

from protocol.messages_pb2 import Scene
from protocol.method import COMPLETE

MOST_OBJECTS = 8  # of a scene whose objects are looked at; where there are more, each is small
LEAST_NODES = 1000  # of an object that takes more than a few milliseconds
COMPLETE_BY = ("auto", COMPLETE)  # preconditioners of scenes that begin with complete factors


def objects_to_prepare(scene: Scene) -> list[str]:
    """Returns the objects whose symbolic phase may be done ahead: those of a scene with few, whose factors will be
    complete."""
    if len(scene.objects) > MOST_OBJECTS:
        return []
    try:
        preconditioner = json.loads(scene.resolved)["solver"]["preconditioner"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return []
    return list(scene.objects) if preconditioner in COMPLETE_BY else []
