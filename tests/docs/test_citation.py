# SPDX-License-Identifier: MIT
"""CITATION.cff says what pyproject.toml does."""

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_it_names_this_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    cited = dict(re.findall(r"^(\w[\w-]*): (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE))
    assert cited["version"] == project["version"] and cited["license"] == project["license"]
    assert cited["title"].lower() == project["name"] and cited["abstract"] == f"{project['description']}."
