# SPDX-License-Identifier: MIT
"""Imports between the folders of a package go one way. `python -m tests.arrows` counts them."""

from pathlib import Path

import pytest

from tests.arrows import PACKAGES, ROOT, Graph, arrows, cycles, floors, private_accesses, report, upward, within

LONG = ROOT / "tests" / "long_tests.txt"
SMALL = ("protocol", "precond_worker", "clients")
MOST_FILES = 12  # of a folder of theirs, without __init__.py
PRIVATE_NAMES = 15  # that tests may use, fewer than
ALLOWED = {  # what each folder imports of its package
    "protocol.access": {"refused"},
    "protocol.network": {"access", "channels", "process", "refused", "shared_memory", "validate"},
    "protocol.materials": set(),
    "protocol.process": set(),
    "protocol.shared_memory": {"channels", "refused", "validate"},
    "precond_worker.symbolic": {"arrays"},
    "precond_worker.gpu": {"arrays", "errors", "many", "symbolic"},
    "precond_worker.factorization": {"arrays", "errors", "gpu", "many", "symbolic"},
    "precond_worker.jobs": {"arrays", "errors", "factorization", "many", "network", "remote_assembly", "symbolic"},
    "precond_worker.network": {"errors", "remote_assembly"},
    "clients.commands": {
        "accuracy",
        "client",
        "errors",
        "export",
        "haptics",
        "identify",
        "load_test",
        "log",
        "materials",
        "obstacle",
        "options",
        "plan",
        "progress",
        "replay",
        "to_json",
        "viewer",
        "watch",
        "web",
    },
    "clients.accuracy": {"errors", "load_test", "log", "progress", "watch"},
    "clients.demo": {"client", "errors", "grab", "load_test", "log"},
    "clients.examples": {"client", "errors", "grab", "log"},
    "clients.export": {"client", "errors", "log", "viewer"},
    "clients.haptics": {"client", "errors", "obstacle"},
    "clients.log": {"errors"},
    "clients.identify": {"accuracy", "errors", "log", "plan", "progress"},
    "clients.materials": {"errors"},
    "clients.options": {"errors"},
    "clients.web": {"client", "errors", "log", "viewer"},
    "clients.viewer": {"client", "errors", "log", "progress"},
    "clients.replay": {"errors", "log", "progress"},
    "clients.load_test": {"client", "errors", "log", "progress", "watch"},
    "clients.plan": {"accuracy", "errors", "log", "progress", "watch"},
}
ORDER = (  # of sim_server: each imports of those before it
    "errors", "arrays", "kernels", "mesh", "scene", "backends", "mechanics", "effects", "parameters", "simulation",
    "state", "updates", "checkpoint", "network", "certificates", "recording", "service", "explain", "replay",
    "embedded", "gym", "startup", "cli", "__main__",
)  # fmt: skip
REGISTRY = ("scene", "effects")  # a scene looks the names of effects up; the effects that it lists are imported later


@pytest.fixture(scope="module")
def graph() -> Graph:
    return arrows()


@pytest.mark.parametrize("package", SMALL)
def test_no_folder_imports_one_that_imports_it(graph: Graph, package: str) -> None:
    assert len(within(graph, package)) > 3
    assert cycles(within(graph, package)) == []


@pytest.mark.parametrize("package", SMALL)
def test_folders_import_what_they_may(graph: Graph, package: str) -> None:
    found = {
        name: {to.split(".", 1)[1] for to in others}
        for name, others in within(graph, package).items()
        if name.count(".") == 1 and (ROOT / name.replace(".", "/")).is_dir()
    }
    assert found == {name: to for name, to in ALLOWED.items() if name.startswith(f"{package}.")}


def test_folders_of_the_server_import_what_stands_below_them(graph: Graph) -> None:
    found = {(a.split(".")[1], b.split(".")[1]) for a, to in within(graph, "sim_server").items() for b in to}
    assert {name for arrow in found for name in arrow} == set(ORDER)
    assert {(a, b) for a, b in found if ORDER.index(b) > ORDER.index(a)} == {REGISTRY}


def test_the_backend_of_the_cpu_knows_none_of_the_gpu() -> None:
    graph = arrows(depth=4)
    for name in ("cpu.native", "cpu"):
        assert not any(".gpu" in to for to in graph[f"sim_server.backends.{name}"]), name
    assert "sim_server.backends.cpu" not in graph["sim_server.backends.cpu.native"]


@pytest.mark.parametrize("package", SMALL)
def test_folders_stay_small(package: str) -> None:
    for folder in {path.parent for path in (ROOT / package).rglob("*.py")}:
        files = [path.name for path in folder.glob("*.py") if path.name != "__init__.py"]
        assert len(files) <= MOST_FILES, f"{folder.relative_to(ROOT)} holds {len(files)} files"


def test_tests_that_are_left_out_are_there() -> None:
    """Names of files and functions; the cases too where all tests are collected by one process (conftest.py)."""
    lines = LONG.read_text().splitlines()
    listed = {(path, name) for path, _, name in (line.partition("[")[0].partition("::") for line in lines)}
    texts = {path: (ROOT / path).read_text() if (ROOT / path).is_file() else "" for path, _ in listed}
    assert [f"{path}::{name}" for path, name in sorted(listed) if f"def {name}(" not in texts[path]] == []


def test_tests_use_few_private_names() -> None:
    found = private_accesses()
    assert len(found) < PRIVATE_NAMES, found


def test_every_use_of_a_private_name_is_found(tmp_path: Path) -> None:
    (tmp_path / "tests" / "bench").mkdir(parents=True)
    lines = [
        "x._a",
        "self._b",
        "x.__dict__",
        "x._fields",
        "from x import _c, d",
        'm.setattr(x, "_e", 1)',
        "x._f._g",
        "C._H",
    ]
    (tmp_path / "tests" / "test_x.py").write_text("\n".join(lines))
    (tmp_path / "tests" / "bench" / "y.py").write_text("x._a")
    assert sorted(place.split()[1] for place in private_accesses(tmp_path)) == ["_H", "_a", "_c", "_e", "_f", "_g"]


def test_every_kind_of_import_is_an_arrow(tmp_path: Path) -> None:
    files = {
        "protocol/a.py": "import protocol.b.x\n",
        "protocol/b/__init__.py": "",
        "protocol/b/x.py": "def f():\n    from protocol import c\n",
        "protocol/b/y.cu": '#include "z.h"\n',
        "protocol/c.py": "if TYPE_CHECKING:\n    from protocol.d.w import W\n",
        "protocol/d/w.py": "W = 1\n",
        "protocol/d/z.h": "int z;\n",
        "clients/e.py": "from protocol.b import x, y\n",
        "tests/test_e.py": "import clients\n",
    }  # fmt: skip
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    found = arrows(tmp_path)
    assert found == {
        "protocol.a": {"protocol.b"}, "protocol.b": {"protocol.c", "protocol.d"}, "protocol.c": {"protocol.d"},
        "protocol.d": set(), "clients.e": {"protocol.b"},
    }  # fmt: skip
    assert (cycles(found), floors(found)) == ([], 4)
    found["protocol.d"].add("protocol.b")
    assert cycles(found) == [{"protocol.b", "protocol.c", "protocol.d"}]
    assert upward(found) == {("protocol.d", "protocol.b")} and floors(found) == 4
    told = list(report(tmp_path))
    assert "| protocol | 4 | 7 | 4 | 4 | 0 | 0 |" in told
    assert "| all | 5 | 8 | 5 (1 between packages) | | | |" in told
    assert "| product | 7 | 2 |" in told and "| tests | 1 | 0 |" in told


def test_the_report_counts_this_product() -> None:
    told = list(report(ROOT))
    assert all(any(line.startswith(f"| {package} |") for line in told) for package in PACKAGES)
    rows = told[told.index("| largest functions of Python | lines |") + 2 :]
    place, lines = rows[0].strip("| ").split(" | ")
    path, name = place.split(": ")
    assert f"def {name}(" in (ROOT / path).read_text() and int(lines) > 20
