# SPDX-License-Identifier: MIT
"""README, CONTRIBUTING and docs: links and quoted paths exist, figures are those of the pages, code runs."""

import ast
import importlib
import re
import tomllib
from functools import cache
from pathlib import Path

import pytest

from tests.docs.figures import DOCS, MARK, ROOT, BadMark, content, filled, texts

PATHS = texts()
TEXTS = pytest.mark.parametrize("path", PATHS, ids=lambda p: str(p.relative_to(ROOT)))
LINKING = sorted({*PATHS, ROOT / "CHANGELOG.md", *DOCS.rglob("*.md")})
QUOTED = re.compile(
    r"`([\w./-]+\.(?:py|cpp|cu|cuh|h|proto|sh)|(?:sim_server|precond_worker|clients|protocol|tests|deploy)/[\w./-]*)`"
)
# A number that only a measurement can tell. What is defined, and so may stand in prose, is listed below.
MEASURED = re.compile(
    r"(?<![\w.-])\d[\d.,-]*(?: (?:to|and) \d[\d.,]*)? (?:µs|ms|%|iterations|times as fast|times faster)(?!\w)"
)
DEFINED = {
    "README.md": {"10-20 %"},
    "scenes.md": {"200 %"},
}


FOLDERS = ("warpfactor", "protocol", "sim_server", "precond_worker", "clients", "deploy", "docs", "tests")


@cache
def known() -> frozenset[str]:
    """Files of the repository and their folders."""
    files = [f for folder in FOLDERS for f in (ROOT / folder).rglob("*") if "__pycache__" not in f.parts]
    return frozenset(str(f.relative_to(ROOT)) for f in (*files, *ROOT.glob("*")))


def without_code(text: str) -> str:
    return re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)


def anchors(path: Path) -> set[str]:
    """Of the headings, as GitHub makes them."""
    found = re.findall(r"^#+ (.+)$", without_code(path.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in found}


@pytest.mark.parametrize("path", LINKING, ids=lambda p: str(p.relative_to(ROOT)))
def test_links(path: Path) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(path.read_text())):
        if re.match(r"https?:", target):
            continue
        name, _, anchor = target.partition("#")
        there = (path.parent / name).resolve() if name else path
        assert there.exists(), target
        assert not anchor or anchor in anchors(there), target


@TEXTS
def test_quoted_paths(path: Path) -> None:
    """`pcg.cu`, `gpu/pcg.cu`, `tests/solver/test_pcg.py`, `tests/bench`: the end of the path of some file or folder."""
    for quoted in QUOTED.findall(without_code(path.read_text())):
        end = quoted.rstrip("/")
        assert any(f == end or f.endswith(f"/{end}") for f in known()), quoted


@TEXTS
def test_figures_are_those_of_the_pages(path: Path) -> None:
    text = path.read_text()
    assert filled(text) == text, "run deploy/run docs"
    assert text.count("<!-- figure ") + text.count("<!-- table ") == len(MARK.findall(text))


@TEXTS
def test_no_measured_number_stands_without_its_page(path: Path) -> None:
    text = re.sub(r"^ {4}.*$", "", MARK.sub("", without_code(path.read_text())), flags=re.MULTILINE)
    found = {m[0] for m in MEASURED.finditer(text)}
    assert not found - DEFINED.get(path.name, set())


def test_a_figure_that_differs_from_its_page_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "page.md").write_text(
        "# Page\n\n## Times\n\n| n | ms |\n| --- | --- |\n| 1 | 2.5 |\n| 2 | 5.5 |\n\nEnd.\n"
    )
    monkeypatch.setattr("tests.docs.figures.DOCS", tmp_path)
    right = "takes <!-- figure page.md | Times | n=2 | ms -->5.5<!-- /figure --> ms"
    assert filled(right) == right == filled(right.replace("5.5", "5.4"))
    whole = "<!-- table page.md | Times | - | n as size; ms -->\n<!-- /table -->"
    assert "| size | ms |\n| --- | --- |\n| 1 | 2.5 |\n| 2 | 5.5 |\n<!--" in filled(whole)
    for wrong in (("other.md", "Times", "-", "ms"), ("page.md", "Bytes", "-", "ms"), ("page.md", "Times", "n=3", "ms")):
        with pytest.raises(BadMark):
            content("figure", *wrong)
    with pytest.raises(BadMark, match="2 rows"):
        content("figure", "page.md", "Times", "-", "ms")
    with pytest.raises(BadMark, match="no column 's'"):
        content("table", "page.md", "Times", "-", "s")


def blocks(language: str) -> list[tuple[str, str]]:
    """(document, text) of the code of one language."""
    pattern = rf"^```{language}\n(.*?)^```"
    return [
        (path.name, code) for path in PATHS for code in re.findall(pattern, path.read_text(), re.MULTILINE | re.DOTALL)
    ]


@pytest.mark.parametrize(("name", "code"), blocks("python"))
def test_python_names_what_is_there(name: str, code: str) -> None:
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.ImportFrom) and node.module:
            module = importlib.import_module(node.module)
            assert all(hasattr(module, alias.name) for alias in node.names), (name, node.module)


def test_python_of_a_run_without_a_network(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    code = next(code for name, code in blocks("python") if name == "use.md" and "wf.Simulation(scene)" in code)
    monkeypatch.chdir(ROOT)
    exec(compile(code, "use.md", "exec"), {})
    assert capsys.readouterr().out


MADE = "finger.msh"  # by a tutorial, which has a test of its own


@pytest.mark.parametrize(("name", "code"), [block for block in blocks("toml") if MADE not in block[1]])
def test_scenes_load(name: str, code: str, tmp_path: Path) -> None:
    from sim_server.scene import load
    from tests.support import organ

    assert tomllib.loads(code)
    if "organ." in code:
        organ.write(tmp_path)
    (tmp_path / "scene.toml").write_text(code)
    assert load(tmp_path / "scene.toml").objects


def test_pages_are_linked_from_the_readme() -> None:
    linked = re.findall(r"\]\((docs/[\w/]+\.md)", (ROOT / "README.md").read_text())
    pages = [p for folder in (DOCS, DOCS / "bench", DOCS / "tutorials") for p in folder.glob("*.md")]
    assert {str(p.relative_to(ROOT)) for p in pages} <= set(linked)
