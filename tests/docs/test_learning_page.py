# SPDX-License-Identifier: MIT
"""The programs of docs/learning.md run as they stand there."""

import re
from pathlib import Path
from typing import Any

import numpy as np

PAGE = (Path(__file__).parents[2] / "docs" / "learning.md").read_text()


def test_the_environment_of_the_page_runs() -> None:
    (text,) = [text for text in re.findall(r"```python\n(.*?)```", PAGE, re.S) if "VectorEnv" in text]
    names: dict[str, Any] = {}
    exec(text, names)
    assert names["observations"].shape == (16, 6 * 10) and np.isfinite(names["observations"]).all()
    assert (names["rewards"] < 0).all() and names["env"].closed
