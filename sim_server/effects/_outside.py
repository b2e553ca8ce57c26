# SPDX-License-Identifier: MIT
"""Effects of other packages, which name them as entry points of the group warpfactor.effects (docs/own_effect.md).

Entry points are read only for a name that is not in the tree, and a package is imported only when a scene lists its
effect. `Code` says what code that was, for logs and replays.
"""

import hashlib
import sys
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from types import ModuleType

from sim_server.errors import InputError

GROUP = "warpfactor.effects"
TEXTS = (".py", ".cu", ".cuh", ".h")
PARTS = ("SCOPE", "Params", "build")  # that the module of an effect has, beside its docstring

_loaded: dict[str, tuple[ModuleType, "Code"]] = {}  # by effect


@dataclass(frozen=True)
class Code:
    """What an effect of another package is. digest: of the Python files of its package in use and its kernel texts."""

    effect: str
    package: str
    digest: str

    def __str__(self) -> str:
        return f"effect {self.effect} of {self.package} ({self.digest})"


def names() -> list[str]:
    """Names of the effects of packages that are installed, sorted; nothing of them is imported."""
    return sorted({point.name for point in entry_points(group=GROUP)})


def load(name: str) -> ModuleType | None:
    """Returns the module of an effect, imported now if it was not yet; None if no package has an effect of that name.

    Raises InputError if several have, or if it cannot be imported or is no effect.
    """
    if name in _loaded:
        return _loaded[name][0]
    points = entry_points(group=GROUP, name=name)
    packages = {_package(point): point for point in points}
    if not packages:
        return None
    if len(packages) > 1:
        raise InputError(f"effect {name!r}: several packages have one: {', '.join(sorted(packages))}; allowed: one")
    ((package, point),) = packages.items()
    try:
        module = point.load()
    except Exception as error:
        raise InputError(
            f"effect {name!r} of {package}: {point.value} cannot be imported: {type(error).__name__}: {error}"
        ) from error
    _check(module, f"effect {name!r} of {package}: {point.value}")
    _loaded[name] = module, Code(name, package, _digest(module))  # before it imports more, as it may at any time
    return module  # type: ignore[no-any-return]


def _package(point: EntryPoint) -> str:
    return f"{point.dist.name} {point.dist.version}" if point.dist is not None else point.value


def _check(module: object, what: str) -> None:
    """Raises InputError unless this is the module of an effect."""
    if not isinstance(module, ModuleType):
        raise InputError(f"{what} is no module, but {type(module).__name__}")
    missing = [part for part in PARTS if not hasattr(module, part)]
    missing += [] if (module.__doc__ or "").strip() else ["a docstring"]
    if missing:
        raise InputError(f"{what} has no {', no '.join(missing)}; the module of an effect has all of them")
    if module.SCOPE not in ("scene", "object"):
        raise InputError(f'{what}: SCOPE = {module.SCOPE!r}; allowed: "scene", "object"')


def effect_of(module: str) -> str:
    """The effect that a loaded module of this name is; empty for one that is none."""
    return next((name for name, (found, _) in _loaded.items() if found.__name__ == module), "")


def code_of(name: str) -> Code:
    """Returns what code an effect that is loaded is."""
    return _loaded[name][1]


def _digest(module: ModuleType) -> str:
    digest = hashlib.sha256()
    for file in _files(module):
        digest.update(file.name.encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()[:16]


def _files(module: ModuleType) -> list[Path]:
    """The module's file, or those of its package that are imported, and all kernel texts in their folders."""
    top = module.__name__.partition(".")[0]
    ours = [m for name, m in list(sys.modules.items()) if name == top or name.startswith(f"{top}.")]
    python = {file for m in ours if (file := Path(getattr(m, "__file__", None) or "")).suffix == ".py"}
    texts = {f for folder in {p.parent for p in python} for f in folder.iterdir() if f.suffix in TEXTS[1:]}
    return sorted(python | texts)
