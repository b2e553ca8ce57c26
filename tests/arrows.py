# SPDX-License-Identifier: MIT
"""Counts what the layout is judged by: `python -m tests.arrows [CHECKOUT]`.

A node is a folder of a package with all that is in it, or a file at the root of a package. An arrow says that a file
of one node imports something of another, at the top of the file, later or for a type alone; or that a C++ or CUDA text
includes a header of another. Arrows that point up: the fewest whose removal leaves no cycle.
"""

import ast
import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from functools import cache
from itertools import permutations
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("protocol", "sim_server", "precond_worker", "clients")
NATIVE = (".cu", ".cuh", ".h", ".cpp")
PRIVATE = re.compile(r"_(?!(fields|replace|asdict|exit)$)[A-Za-z0-9]\w*(?<!_)")  # but for a named tuple and os._exit
LISTED = 5  # of the largest files and functions
Graph = dict[str, set[str]]


@cache
def sources(root: Path, folder: str) -> dict[Path, str]:
    """Texts of a folder, without what a program generated."""
    files = sorted((root / folder).rglob("*"))
    wanted = [f for f in files if f.suffix in (".py", *NATIVE) and not f.stem.endswith("_pb2")]
    return {f: f.read_text() for f in wanted}


def product(root: Path) -> dict[Path, str]:
    """Texts of all packages."""
    return {path: text for package in PACKAGES for path, text in sources(root, package).items()}


def node(root: Path, path: Path, depth: int) -> str:
    """Node that a file belongs to: "sim_server.backends", or "sim_server.cli" for a file at the root."""
    parts = path.relative_to(root).with_suffix("").parts
    return ".".join(parts if len(parts) == 2 else parts[: min(len(parts) - 1, depth)])


def imported(text: str) -> Iterator[str]:
    """Modules that a text of Python imports anywhere, and what it imports from them."""
    for found in ast.walk(ast.parse(text)):
        if isinstance(found, ast.Import):
            yield from (alias.name for alias in found.names)
        elif isinstance(found, ast.ImportFrom):
            yield from (f"{found.module}.{alias.name}" for alias in found.names)


def arrows(root: Path = ROOT, depth: int = 2) -> Graph:
    """Nodes that each node of the product depends on. depth: 2: folders within folders are no nodes of their own."""
    texts = product(root)
    modules = {".".join(f.relative_to(root).with_suffix("").parts).removesuffix(".__init__"): f for f in texts}
    headers = {f.name: f for f in texts if f.suffix in (".h", ".cuh")} | {f: f for f in texts}
    graph: Graph = {}
    for path, text in texts.items():
        if path.name == "__init__.py" and len(path.relative_to(root).parts) == 2:
            continue  # of a package: empty
        own = node(root, path, depth)
        graph.setdefault(own, set())
        if path.suffix == ".py":
            found = [modules.get(name) or modules.get(name.rpartition(".")[0]) for name in imported(text)]
        else:
            names = re.findall(r'#include "([^"]+)"', text)
            found = [headers.get((path.parent / name).resolve()) or headers.get(Path(name).name) for name in names]
        graph[own] |= {node(root, f, depth) for f in found if f is not None} - {own}
    return {name: to & graph.keys() for name, to in graph.items()}


def within(graph: Graph, package: str) -> Graph:
    """The part of a graph that is one package."""
    names = {name for name in graph if name.split(".")[0] == package}
    return {name: graph[name] & names for name in sorted(names)}


def cycles(graph: Graph) -> list[set[str]]:
    """Sets of nodes each of which depends on all others of its set."""
    reach = {name: _reached(graph, name) for name in graph}
    found = {frozenset(b for b in graph if b in reach[a] and a in reach[b]) for a in graph}
    return [set(nodes) for nodes in found if len(nodes) > 1]


def upward(graph: Graph) -> set[tuple[str, str]]:
    """Returns the fewest arrows whose removal leaves no cycle, one such choice; nearly so in cycles of many nodes."""
    return {arrow for nodes in cycles(graph) for arrow in _against({n: graph[n] & nodes for n in sorted(nodes)})}


def floors(graph: Graph) -> int:
    """Returns the number of nodes on the longest way down, after arrows that point up are removed."""
    up = upward(graph)

    @cache
    def height(name: str) -> int:
        return 1 + max((height(to) for to in graph[name] if (name, to) not in up), default=0)

    return max(map(height, graph), default=0)


def _reached(graph: Graph, start: str) -> set[str]:
    found, todo = set(), [start]
    while todo:
        for to in graph[todo.pop()] - found:
            found.add(to)
            todo.append(to)
    return found


def _against(graph: Graph) -> set[tuple[str, str]]:
    """Arrows that an order of the nodes of a cycle leaves pointing back, in the best order found."""

    def back(order: Iterable[str]) -> set[tuple[str, str]]:
        rank = {name: k for k, name in enumerate(order)}
        return {(a, b) for a in graph for b in graph[a] if rank[b] > rank[a]}

    if len(graph) <= 7:
        return min(map(back, permutations(graph)), key=len)
    order = sorted(graph, key=lambda name: len(graph[name]))
    improved = True
    while improved:  # move single nodes as long as that helps
        improved = False
        for name in sorted(graph):
            rest = [n for n in order if n != name]
            better = min(([*rest[:k], name, *rest[k:]] for k in range(len(order))), key=lambda o: len(back(o)))
            if len(back(better)) < len(back(order)):
                order, improved = better, True
    return back(order)


def functions(texts: dict[Path, str]) -> list[tuple[int, str, Path]]:
    """Lines, name and file of the functions of Python, the largest first."""
    found = [
        (n.end_lineno - n.lineno + 1, n.name, path)
        for path, text in texts.items() if path.suffix == ".py" for n in ast.walk(ast.parse(text))
        if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef) and n.end_lineno
    ]  # fmt: skip
    return sorted(found, key=lambda f: -f[0])


def lines(texts: dict[Path, str]) -> tuple[int, int]:
    """Lines of Python, and of C++ and CUDA."""
    count = {path: len(text.splitlines()) for path, text in texts.items()}
    python = sum(n for path, n in count.items() if path.suffix == ".py")
    return python, sum(count.values()) - python


def private_accesses(root: Path = ROOT) -> list[str]:
    """Places where a test other than a bench uses a private name of something else: `x._name`, where x is not self or
    cls, `from x import _name` or `monkeypatch.setattr(x, "_name", ...)`."""
    found = []
    for path, text in sources(root, "tests").items():
        if path.suffix != ".py" or path.relative_to(root).parts[1] == "bench":
            continue
        for n in ast.walk(ast.parse(text)):
            names: list[str] = []
            if isinstance(n, ast.Attribute) and not (isinstance(n.value, ast.Name) and n.value.id in ("self", "cls")):
                names = [n.attr]
            elif isinstance(n, ast.ImportFrom):
                names = [alias.name for alias in n.names]
            elif isinstance(n, ast.Call) and isinstance(n.func, ast.Attribute) and n.func.attr == "setattr":
                names = [
                    a.value.split(".")[-1] for a in n.args if isinstance(a, ast.Constant) and isinstance(a.value, str)
                ]
            found += [f"{path.relative_to(root)}:{n.lineno} {name}" for name in names if PRIVATE.fullmatch(name)]
    return found


def report(root: Path) -> Iterator[str]:
    """Lines of the tables, as Markdown."""
    graph, texts, tests = arrows(root), product(root), sources(root, "tests")
    yield "| package | folders and root files | files | arrows | floors | pointing up | in cycles |"
    yield "|---|---|---|---|---|---|---|"
    for package in PACKAGES:
        g, count = within(graph, package), len(sources(root, package))
        up, around = upward(g), sum(map(len, cycles(g)))
        yield f"| {package} | {len(g)} | {count} | {_count(g)} | {floors(g)} | {len(up)} | {around} |"
    inside = sum(_count(within(graph, package)) for package in PACKAGES)
    yield f"| all | {len(graph)} | {len(texts)} | {_count(graph)} ({_count(graph) - inside} between packages) | | | |"
    for package in PACKAGES:
        yield from (f"- up: {a} -> {b}" for a, b in sorted(upward(within(graph, package))))
    bench = {path: text for path, text in tests.items() if path.relative_to(root).parts[1].startswith("bench")}
    rest = {path: text for path, text in tests.items() if path not in bench}
    yield from ("", "| lines | Python | C++ and CUDA |", "|---|---|---|")
    for name, kind in (("product", texts), ("tests", rest), ("benches and their tests", bench)):
        yield "| {} | {} | {} |".format(name, *lines(kind))
    yield from ("", f"Private names used by tests: {len(private_accesses(root))}")
    yield from ("", "| largest files | lines |", "|---|---|")
    for path, text in sorted(texts.items(), key=lambda item: -len(item[1].splitlines()))[:LISTED]:
        yield f"| {path.relative_to(root)} | {len(text.splitlines())} |"
    yield from ("", "| largest functions of Python | lines |", "|---|---|")
    for length, name, path in functions(texts)[:LISTED]:
        yield f"| {path.relative_to(root)}: {name} | {length} |"
    most = Counter(path.parent for path in texts).most_common(LISTED)
    yield from ("", "| folders of most files | files |", "|---|---|")
    yield from (f"| {folder.relative_to(root)} | {n} |" for folder, n in most)


def _count(graph: Graph) -> int:
    return sum(map(len, graph.values()))


if __name__ == "__main__":
    print("\n".join(report(Path(sys.argv[1]).resolve() if len(sys.argv) > 1 else ROOT)))
