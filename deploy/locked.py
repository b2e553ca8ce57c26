# SPDX-License-Identifier: MIT
"""Prints the requirements, pinned and with hashes, of extras of pyproject.toml: python3 deploy/locked.py server mesh

deploy/constraints.txt has all packages of all extras, each with those that need it. What the named extras need is found
by these notes, so that pip need not resolve anything: pip install --no-deps --require-hashes -r FILE. The groups of
pyproject.toml may be named, too: `build` is what the project, and scikit-sparse, are built with.
"""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PIN = re.compile(r"^([A-Za-z0-9._-]+)(?:\[[^]]*\])?==")


def normal(name: str) -> str:
    """The name of a package as indexes compare it."""
    return re.sub(r"[-_.]+", "-", re.split(r"[\s;\[<>=!~(@]", name.strip(), maxsplit=1)[0]).lower()


def blocks(text: str) -> dict[str, tuple[list[str], set[str]]]:
    """Lines of each package with its hashes, and who needs it. A name may come twice, for two versions of Python."""
    found: dict[str, tuple[list[str], set[str]]] = {}
    name = ""
    for line in text.splitlines():
        if pin := PIN.match(line):
            name = normal(pin[1])
            found.setdefault(name, ([], set()))[0].append(line)
        elif name and (said := re.match(r"\s+#\s*(?:via\s+)?(.*)", line)):
            found[name][1].update(normal(part) for part in said[1].split(",") if part.strip())
        elif name and line.strip() and not line.startswith("#"):
            found[name][0].append(line)
    return found


def needed(roots: set[str], packages: dict[str, tuple[list[str], set[str]]]) -> set[str]:
    """Names of the roots and of all that they need."""
    wanted = roots & packages.keys()
    while more := {name for name, (_, users) in packages.items() if name not in wanted and users & wanted}:
        wanted |= more
    return wanted


def requirements(extras: list[str], root: Path = ROOT) -> str:
    """Lines for pip. Raises ValueError for an extra that there is not, or a package without a pin."""
    project = tomllib.loads((root / "pyproject.toml").read_text())
    lists = {**project["project"]["optional-dependencies"], **project["dependency-groups"]}
    if unknown := [extra for extra in extras if extra not in lists]:
        raise ValueError(f"no extra {', '.join(unknown)}; there are {', '.join(sorted(lists))}")
    base = [] if project["dependency-groups"].keys() >= set(extras) else project["project"]["dependencies"]
    roots = {normal(requirement) for extra in extras for requirement in lists[extra]} | {normal(r) for r in base}
    packages = blocks((root / "deploy" / "constraints.txt").read_text())
    if missing := roots - packages.keys():
        raise ValueError(
            f"deploy/constraints.txt lacks {', '.join(sorted(missing))}: its first lines say how to remake it"
        )
    lines = [line for name in sorted(needed(roots, packages)) for line in packages[name][0]]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    try:
        print(requirements(sys.argv[1:]), end="")
    except ValueError as error:
        sys.exit(f"deploy/locked.py: {error}")
