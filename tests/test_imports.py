# SPDX-License-Identifier: MIT
"""Imports go one way: everybody imports protocol, and nobody anybody else; tests of the product import no bench."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ALLOWED = {
    "warpfactor": {"warpfactor", "protocol", "clients", "sim_server"},  # the public face of all others
    "protocol": {"protocol"},
    "sim_server": {"sim_server", "protocol"},
    "precond_worker": {"precond_worker", "protocol"},
    "clients": {"clients", "protocol"},
}
# Imported when they are needed: the server may factorize in its own process, a replay makes
# factors as its workers did, a worker compiles as the server does and may assemble the matrix itself.
EXCEPTIONS = {
    ("sim_server", "precond_worker.factorization.factorize"),
    ("sim_server", "precond_worker.factorization.registry"),
    ("sim_server", "precond_worker.errors"),
    ("sim_server", "precond_worker.gpu.device"),
    ("precond_worker", "sim_server.backends.compiler"),
    ("precond_worker", "sim_server.backends.build_pool"),
    ("precond_worker", "sim_server.updates.worker_assembly"),
}


def imported(node: ast.AST, path: Path) -> list[str]:
    """Names of the modules that a statement imports; `from a import b` imports a."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if not isinstance(node, ast.ImportFrom):
        return []
    assert node.level == 0, f"{path}: relative import"
    return [node.module or ""]


@pytest.mark.parametrize("package", ALLOWED)
def test_directions(package: str) -> None:
    files = list((ROOT / package).rglob("*.py"))
    assert files
    for path in files:
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            for module in imported(node, path):
                ours = module.split(".")[0] in ALLOWED
                exempt = (package, module) in EXCEPTIONS and node not in tree.body
                assert not ours or exempt or module.split(".")[0] in ALLOWED[package], f"{path} imports {module}"


def test_scenes_know_nothing_of_what_is_built_from_them() -> None:
    """Options stand where they are parsed. The registry of effects is looked up by name, effects themselves later."""
    allowed = ("sim_server.arrays", "sim_server.effects", "sim_server.errors", "sim_server.mesh", "sim_server.scene")
    for path in (ROOT / "sim_server" / "scene").glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("sim_server"):
                modules = [f"{node.module}.{alias.name}" for alias in node.names]
                assert all(m.startswith(allowed) for m in modules), f"{path} imports {modules}"


def test_tests_of_the_product_import_no_bench() -> None:
    """What both need is in tests/support."""
    benches = [ROOT / "tests" / name for name in ("bench", "bench_smoke")]
    files = [p for p in (ROOT / "tests").rglob("*.py") if not any(p.is_relative_to(folder) for folder in benches)]
    assert ROOT / "tests/support/virtual_workers.py" in files
    for path in (path for path in files if "bench" in path.read_text()):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.ImportFrom) else []
            modules = imported(node, path)
            for module in [*modules, *(f"{modules[0]}.{name}" for name in names)]:
                assert not f"{module}.".startswith(("tests.bench.", "tests.bench_smoke.")), f"{path} imports {module}"


def test_the_public_face_stays_small() -> None:
    lines = sum(len(path.read_text().splitlines()) for path in (ROOT / "warpfactor").glob("*.py"))
    assert lines <= 60 and (ROOT / "warpfactor/py.typed").is_file()


def test_the_top_level_holds_the_packages_and_no_module() -> None:
    assert {path.parent.name for path in ROOT.glob("*/__init__.py")} - {"tests"} == {*ALLOWED}
    assert list(ROOT.glob("*.py")) == []
