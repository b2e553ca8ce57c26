# SPDX-License-Identifier: MIT
"""Thirty steps of each scene of the gallery on a GPU lead where those on a CPU do. Runs where there is a GPU."""

import pytest

from tests.scene.test_gallery import DIFFERENT, MOVED, moved_in_thirty_steps

pytestmark = pytest.mark.gpu


@pytest.mark.parametrize("name", sorted(MOVED))
@pytest.mark.parametrize("update", ["every-10", "lockstep-3"])
def test_thirty_steps(name: str, update: str) -> None:
    assert moved_in_thirty_steps(name, update, "gpu") == pytest.approx(MOVED[name], rel=5 * DIFFERENT)
