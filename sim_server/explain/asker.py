# SPDX-License-Identifier: MIT
"""Who asks: the effect nearest up the call stack.

Code runs for an effect while a function of its module runs, a method of it as an object (laws share classes), or its
import. Slow, as it looks at each frame of the stack: for explanations, not for steps.
"""

import sys
from collections.abc import Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import FrameType, ModuleType

from sim_server import effects
from sim_server.effects._base import Effect

CORE = "core"  # asks for what every scene has


def asker() -> str:
    """Returns the name of the effect for which the caller runs; CORE if it runs for none."""
    frame: FrameType | None = sys._getframe(1)
    while frame is not None:
        if name := _asking(frame):
            return name
        frame = frame.f_back
    return CORE


def _asking(frame: FrameType) -> str:
    if name := effects.effect_of(frame.f_globals.get("__name__", "")):
        return name
    if frame.f_code is effects.effect.__code__:  # imports it
        return str(frame.f_locals["name"])
    owner = frame.f_locals.get("self")
    return owner.name if isinstance(owner, Effect) else ""


class Imports(MetaPathFinder):
    """Notes who asked for each module that is imported in its context; it finds none itself.

    found: asker by name of the module, in the order in which imports began
    """

    def __init__(self) -> None:
        self.found: dict[str, str] = {}

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Notes the asker; another finder finds the module."""
        self.found.setdefault(fullname, asker())
        return None

    def __enter__(self) -> "Imports":
        sys.meta_path.insert(0, self)
        return self

    def __exit__(self, *_: object) -> None:
        sys.meta_path.remove(self)
