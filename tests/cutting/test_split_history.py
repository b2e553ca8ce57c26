# SPDX-License-Identifier: MIT
"""Epochs of bodies that are split again and again, as several threads ask for them."""

from types import SimpleNamespace
from typing import Any

import pytest

from sim_server.mechanics.split_history import KEPT, SplitHistory
from sim_server.mechanics.splitting import KEY


class Followed:
    """Stands for the pattern that follows the scene: a number. looks: called while it is computed, as threads ask."""

    def __init__(self) -> None:
        self.looks: Any = lambda: None

    def body_pattern(self, scene: Any, first: int, last: int) -> Any:
        self.looks()
        return scene


@pytest.mark.parametrize("every", [1, 3])
def test_an_epoch_keeps_its_number_and_pattern_while_a_split_is_prepared(every: int) -> None:
    """every: of how many splits the loop takes up one, before it was replaced."""
    body = SimpleNamespace(name="liver", first=0, last=4)
    followed = Followed()
    system: Any = SimpleNamespace(
        world=SimpleNamespace(bodies=[body]), followed=followed, body_pattern=lambda first, last: 0
    )
    history = SplitHistory(system)
    epoch, newest = 1, 0
    for step in range(1, 3 * KEPT):

        def look(epoch: int = epoch, newest: int = newest, step: int = step) -> None:
            assert history.at("liver", step) == epoch
            assert history.pattern("liver", epoch) == newest

        followed.looks = look
        update = SimpleNamespace(values={KEY.format("liver"): "1"}, taken=-1)
        history.on_set(update, step)  # type: ignore[arg-type]
        look()
        if step % every == 0:
            update.taken = step - 1
            epoch, newest = epoch + 1, step
        look(epoch, newest)
        assert history.at("liver", 1 << 40) == epoch
    assert epoch == 1 + (3 * KEPT - 1) // every
    assert history.pattern("liver", epoch - 5) == newest - 5 * every
