# SPDX-License-Identifier: MIT
"""Trees of boxes: every triangle once, children after their parents, and no higher than promised."""

import numpy as np
import pytest

from sim_server.mesh.box_tree import box_tree


def heights(children: np.ndarray) -> np.ndarray:
    """Height of each box above its lowest triangle, 0 for a box of one triangle."""
    found = np.zeros(len(children), int)
    for k in range(len(children) - 1, -1, -1):
        if children[k, 0] >= 0:
            found[k] = 1 + found[children[k]].max()
    return found


@pytest.mark.parametrize("spread", ["everywhere", "along a line", "all in one place", "growing"])
@pytest.mark.parametrize("count", [1, 2, 3, 7, 8, 9, 100, 1025])
def test_every_triangle_is_in_one_box_and_the_tree_is_low(count, spread):
    centres = np.random.default_rng(count).uniform(-1, 1, (count, 3))
    if spread != "everywhere":
        centres *= [1, 0, 0]
    if spread == "all in one place":
        centres[:] = 0.5
    if spread == "growing":
        centres[:, 0] = 2.0 ** (np.arange(count) / 2)
    children = box_tree(centres)
    assert children.shape == (2 * count - 1, 2) and children.dtype == np.int32
    leaf = children[:, 0] < 0
    assert np.array_equal(children[leaf, 0], children[leaf, 1])
    assert sorted(~children[leaf, 0]) == list(range(count))
    assert (children[~leaf] > np.flatnonzero(~leaf)[:, None]).all()
    assert sorted(children[~leaf].ravel()) == list(range(1, 2 * count - 1))  # each box but the first has one parent
    assert heights(children)[0] <= np.ceil(np.log2(count))


def test_boxes_are_halved_along_their_longest_side():
    centres = np.array([[x, 0.1 * (x % 3), 0] for x in range(8)], float)
    children = box_tree(centres[::-1])

    def below(box: int) -> set[int]:
        a, b = children[box]
        return {7 - int(~a)} if a < 0 else below(a) | below(b)

    assert [below(k) for k in children[0]] == [{0, 1, 2, 3}, {4, 5, 6, 7}]
