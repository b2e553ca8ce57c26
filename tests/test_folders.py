# SPDX-License-Identifier: MIT
"""Imports between the folders of a package go one way. `python tests/test_folders.py` prints them.

A folder is a node of the graph, and so is a file at the root of the package.
"""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("protocol", "precond_worker", "clients")
MOST_FILES = 12  # of a folder, without __init__.py
ALLOWED = {  # what each folder imports of its package
    "protocol.network": {"channels", "shared_memory"},
    "protocol.process": set(),
    "protocol.shared_memory": {"channels", "messages_pb2", "refused", "validate"},
    "precond_worker.symbolic": {"arrays"},
    "precond_worker.gpu": {"arrays", "errors", "symbolic"},
    "precond_worker.factorization": {"arrays", "errors", "gpu", "symbolic"},
    "precond_worker.network": {"errors", "remote_assembly"},
    "clients.log": {"errors"},
    "clients.viewer": {"client", "errors", "log", "progress"},
    "clients.replay": {"errors", "log", "progress"},
    "clients.load_test": {"client", "errors", "log", "progress", "watch"},
}


def imported(path: Path) -> set[str]:
    """Modules that a file imports anywhere, and what it imports from them."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def arrows(package: str) -> dict[str, set[str]]:
    """Which nodes of a package each of its nodes imports."""
    files = {path: path.relative_to(ROOT).with_suffix("").parts for path in (ROOT / package).rglob("*.py")}
    nodes = {parts[1] for parts in files.values()} - {"__init__"}
    graph: dict[str, set[str]] = {node: set() for node in nodes}
    for path, (_, node, *_) in files.items():
        names = {module.split(".")[1] for module in imported(path) if module.startswith(f"{package}.")}
        graph.setdefault(node, set()).update((names & nodes) - {node})
    return graph


@pytest.mark.parametrize("package", PACKAGES)
def test_no_folder_imports_one_that_imports_it(package: str) -> None:
    assert list(TopologicalSorter(arrows(package)).static_order())  # raises CycleError with the cycle


@pytest.mark.parametrize("package", PACKAGES)
def test_folders_import_what_they_may(package: str) -> None:
    found = {f"{package}.{node}": to for node, to in arrows(package).items() if (ROOT / package / node).is_dir()}
    assert found == {node: to for node, to in ALLOWED.items() if node.startswith(f"{package}.")}


@pytest.mark.parametrize("package", PACKAGES)
def test_folders_stay_small(package: str) -> None:
    for folder in {path.parent for path in (ROOT / package).rglob("*.py")}:
        files = [path.name for path in folder.glob("*.py") if path.name != "__init__.py"]
        assert len(files) <= MOST_FILES, f"{folder.relative_to(ROOT)} holds {len(files)} files"


if __name__ == "__main__":
    for name in PACKAGES:
        for node, to in sorted(arrows(name).items()):
            print(f"{name}.{node}: {', '.join(sorted(to)) or '-'}")
