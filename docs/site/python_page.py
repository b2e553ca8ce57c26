# SPDX-License-Identifier: MIT
"""The reference of Python: what `import warpfactor` offers, from its docstrings."""

import inspect
from types import ModuleType

import warpfactor

INTRO = """\
# Python

What `import warpfactor as wf` offers, from the docstrings. [From Python](../use.md#from-python) shows it at work; what
a name promises over versions says [compatibility](../compatibility.md). Shapes of arrays are in parentheses, units in
brackets.

"""


RETURNED = {"Client": ("clients.grab.Grab", "clients.obstacle.Obstacle")}  # handles that methods of a class return


def page() -> str:
    """The whole page in Markdown, with directives of Sphinx."""
    return INTRO + "".join(_entry(name) for name in warpfactor.__all__)


def _entry(name: str) -> str:
    found = getattr(warpfactor, name)
    if isinstance(found, ModuleType):
        public = getattr(found, "__all__", None) or [n for n in vars(found) if _is_of(found, n)]
        return f"## wf.{name}\n\n{_directive('module', found.__name__, members=False)}" + "".join(
            _directive(_kind(getattr(found, each)), f"{found.__name__}.{each}") for each in public
        )
    handles = "".join(_directive("class", place) for place in RETURNED.get(name, ()))
    return f"## wf.{name}\n\n{_directive(_kind(found), f'warpfactor.{name}')}{handles}"


def _is_of(module: ModuleType, name: str) -> bool:
    found = getattr(module, name)
    return not name.startswith("_") and callable(found) and found.__module__.startswith(module.__name__)


def _kind(found: object) -> str:
    return "class" if inspect.isclass(found) else "function" if callable(found) else "data"


def _directive(kind: str, name: str, members: bool = True) -> str:
    options = "   :members:\n   :special-members: __enter__\n" if kind == "class" and members else ""
    return f"```{{eval-rst}}\n.. auto{kind}:: {name}\n{options}```\n\n"
