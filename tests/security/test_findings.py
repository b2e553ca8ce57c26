# SPDX-License-Identifier: MIT
"""The list of findings of tests/attacks/README.md: each names a test that is there."""

import re
from pathlib import Path

import pytest

from tests.system.server_process import Stage, beam, until

ROOT = Path(__file__).parents[2]


def test_each_finding_has_a_test() -> None:
    table = (ROOT / "tests/attacks/README.md").read_text()
    rows = re.findall(r"^\| (\d+) \|.*`(tests/\S+\.py)::(test_\w+)` \|$", table, re.M)
    assert [int(number) for number, _, _ in rows] == list(range(1, 30))
    for number, path, name in rows:
        assert re.search(rf"^def {name}\(", (ROOT / path).read_text(), re.M), (number, path, name)


@pytest.mark.system
def test_a_plain_start_warns_of_nothing(tmp_path: Path) -> None:
    """The first factor of an object travels as bytes, which nobody need be told."""
    stage = Stage(tmp_path)
    try:
        scene = beam(tmp_path)
        scene.write_text(scene.read_text().replace('"cholesky"', '"incomplete_cholesky"'))
        server = stage.server(scene, "--workers", "1")
        with stage.client() as client:
            until(lambda: client.status(fresh=True).objects[0].last.factor_step > 20, "a few factors")
        assert server.end() == 0
        assert "slot" not in server.output() and "refused" not in server.output(), server.output()
    finally:
        stage.close()
