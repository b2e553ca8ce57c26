# SPDX-License-Identifier: MIT
"""The garbage collector and what stays as long as a program runs."""

import gc
import weakref

from protocol.process.memory import YOUNG, keep_long_lived


class Node:
    pass


def test_collections_go_through_what_was_made_since_alone():
    before, threshold = len(gc.get_objects()), gc.get_threshold()
    try:
        keep_long_lived()
        assert gc.get_threshold() == (max(YOUNG, threshold[0]), *threshold[1:])
        assert gc.get_freeze_count() > before / 2 and len(gc.get_objects()) < before / 10
        node = Node()
        node.itself, seen = node, weakref.ref(node)
        del node
        gc.collect()
        assert seen() is None
    finally:
        gc.unfreeze()
        gc.set_threshold(*threshold)
