# SPDX-License-Identifier: MIT
"""What is there before a program begins its work stays as long as it runs."""

import gc


def keep_long_lived() -> None:
    """Has the garbage collector never look again at the objects that are there now. A collection of all generations
    would go through them, modules and what they hold, and keep Python's lock for some 50 ms meanwhile."""
    gc.collect()
    gc.freeze()
