# SPDX-License-Identifier: MIT
"""Sphinx configuration. `python -m docs.site` lays out the pages that it reads (stage.py)."""

import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from docs.site.docstrings import as_rest  # noqa: E402  the path comes first

project = "Warpfactor"
author = "The Warpfactor authors"
release = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
copyright = author

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_design", "sphinx_copybutton"]
source_suffix = {".md": "markdown"}
root_doc = "index"
myst_heading_anchors = 6  # as on GitHub
myst_enable_extensions = ["colon_fence"]  # beside what GitHub renders: for directives on the pages of this folder
suppress_warnings = [
    "misc.highlighting_failure",  # "..." in examples
    "myst.header",  # pages of benches go from H1 to H3
]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_mock_imports = ["cupy", "gymnasium"]  # of extras that the site does without
python_maximum_signature_line_length = 88

html_theme = "pydata_sphinx_theme"
html_title = f"Warpfactor {release}"
smartquotes = False  # "--web" is no dash
html_show_sourcelink = False
html_copy_source = False
html_static_path = ["static"]
html_css_files = ["wide.css"]
html_theme_options = {
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "show_toc_level": 2,
    "header_links_before_dropdown": 8,
    "footer_start": ["copyright"],
    "footer_end": [],
}
copybutton_exclude = ".linenos, .gp, .go"

linkcheck_timeout = 20
linkcheck_anchors = False  # pages that are made in the browser have none
linkcheck_ignore = [r"http://127\.0\.0\.1.*", r"https://doi\.org/.*"]  # publishers turn programs away


def setup(app) -> None:  # type: ignore[no-untyped-def]  # Sphinx has the type, and is imported by itself
    app.connect("autodoc-process-docstring", as_rest)
