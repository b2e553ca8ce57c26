# SPDX-License-Identifier: MIT
"""docs/materials.md has each material as its file says it."""

from protocol import materials
from tests.docs.figures import table_under
from tests.docs.material_page import PAGE, page


def test_the_page_is_that_of_the_files() -> None:
    assert PAGE.read_text() == page(), "run python -m tests.docs.material_page"
    rows = table_under(PAGE.read_text(), "Materials")
    assert [row["name"].split("]")[0][1:] for row in rows] == materials.names()
