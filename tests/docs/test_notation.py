# SPDX-License-Identifier: MIT
"""docs/notation.md names what is there."""

import re

import pytest

from tests.docs.figures import DOCS, table_under

TEXT = (DOCS / "notation.md").read_text()
HEADINGS = [h for h in re.findall(r"^## (.+)$", TEXT, re.MULTILINE) if h != "Preconditioners in time"]


@pytest.mark.parametrize("heading", HEADINGS)
def test_names_stand_in_the_files_that_are_named(heading: str) -> None:
    section = TEXT.split(f"## {heading}\n")[1].split("\n## ")[0]
    files = [(DOCS / path).read_text() for path in re.findall(r"\]\((\.\./[^)]+)\)", section)]
    assert files
    names = [name for row in table_under(TEXT, heading) for name in re.findall(r"`(\w+)`", row["code"])]
    assert names
    for name in names:
        assert any(re.search(rf"\b{name}\b", text) for text in files), name


def test_the_code_refers_to_it() -> None:
    for file in ("world.py", "integrator.py"):
        (path,) = (DOCS.parent / "sim_server").rglob(file)
        assert "docs/notation.md" in path.read_text(), file
