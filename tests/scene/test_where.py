# SPDX-License-Identifier: MIT
"""Expressions over rest coordinates: meaning, and refusal of everything else."""

import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.scene.where import mask

POINTS = np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.0], [2.0, 1.0, -1.0], [3.0, 1.5, 4.0]])


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("X < 0.01", "1000"),
        ("X < 0.01 and abs(Y - 1) <= 0.5", "0000"),
        ("X > 0.5 and abs(Y - 1) <= 0.5", "0111"),
        ("X < 0.5 or Z > 3", "1001"),
        ("not X < 0.5", "0111"),
        ("not (X < 0.5 or Z > 3)", "0110"),
        ("0 < X <= 2 < 2.5", "0110"),
        ("X == 1", "0100"),
        ("X != 1", "1011"),
        ("sqrt(X**2 + Y**2) >= 2", "0011"),
        ("min(X, Y, Z) < 0", "0010"),
        ("max(X, 2*Y, -Z) > 2.5", "0001"),
        ("-X + +Y > -1", "1100"),
        ("true", "1111"),
        ("not true", "0000"),
        ("true and X > 0", "0111"),
        ("X > 0\n  and Y < 1", "0100"),
        ("X > 0 and 1/X < 0.6", "0011"),  # the right side is not looked at where X = 0
        ("X == 0 or 1/X > 0.9", "1100"),
        ("  X**-1 > 0 or true", None),  # 0 ** -1
        ("2**0.5 < X", "0011"),
    ],
)
def test_meaning(expression, expected):
    if expected is None:
        with pytest.raises(InputError, match=r"not a finite number at the point \(0, 0, 0\)"):
            mask(expression, POINTS)
    else:
        assert "".join(str(int(held)) for held in mask(expression, POINTS)) == expected


def test_no_points_and_no_change_of_the_points():
    points = POINTS.copy()
    assert mask("X < 1 and not Y > 0", points[:0]).shape == (0,)
    mask("-X < Y or Z > abs(X)", points)
    assert np.array_equal(points, POINTS)


@pytest.mark.parametrize(
    ("expression", "words"),
    [
        ("__import__('os').system('true')", "not allowed"),
        ("__import__('os')", "unknown function '__import__'"),
        ("X.__class__", "'X.__class__' is not allowed"),
        ("X.shape < 3", "not allowed"),
        ("().__class__.__bases__[0] < 1", "not allowed"),
        ("[c for c in (1, 2)] < X", "not allowed"),
        ("(lambda: X)() < 1", "not allowed"),
        ("X if Y else Z", "not allowed"),
        ("(X := 3) < 1", "not allowed"),
        ("f'{X}' < 'a'", "not allowed"),
        ("X < 'a'", "not allowed"),
        ("X < 1j", "not allowed"),
        ("X < True", "not allowed"),
        ("X in (1, 2)", "not allowed"),
        ("X is Y", "not allowed"),
        ("X // 2 < 1", "not allowed"),
        ("X % 2 < 1", "not allowed"),
        ("~X < 1", "not allowed"),
        ("X < 1 & Y < 1", "not allowed"),
        ("sqrt(x=1) < 1", "not allowed"),
        ("max(X, *Y) < 1", "not allowed"),
        ("exec('1')", "unknown function 'exec'"),
        ("abs(X, Y) < 1", "abs takes one value, not 2"),
        ("min(X) < 1", "min takes two or more values, not 1"),
        ("x < 1", "unknown name 'x' (write X)"),
        ("W < 1", "unknown name 'W'"),
        ("X", "'X' must be a comparison, not a number"),
        ("X + (Y > 0) < 1", "'Y > 0' must be a number, not a comparison"),
        ("X and Y > 0", "'X' must be a comparison"),
        ("X <", "cannot be read"),
        ("", "cannot be read"),
        ("X < 1; Y", "cannot be read"),
        ("X < \0", "cannot be read"),
        ("(" * 400 + "X" + ")" * 400 + "< 1", "cannot be read"),
        ("9**9**9**9**9 < X", "not a finite number"),
        ("X < 10**400", "not a finite number"),
        ("X < 1" + "0" * 400, "too large"),
        ("X < 1e999", "too large"),
        ("sqrt(X - 1) < 1", "'sqrt(X - 1)' is not a finite number at the point (0, 0, 0)"),
        ("X/X < 1", "not a finite number"),
        ("-" * 500 + "X < 1", "nested more than 40 levels"),
        ("-" * 100 + "X", "nested more than 40 levels"),
        ("X" + " + X" * 200 + " < 1", "nested more than 40 levels"),
        ("X < 1 or " * 200 + "true", "longer than 1000 characters"),
    ],
)
def test_everything_else_is_refused_and_says_what_is_allowed(expression, words):
    with pytest.raises(InputError) as error:
        mask(expression, POINTS)
    assert words in str(error.value)
    assert "allowed: the rest coordinates X, Y, Z" in str(error.value)
    assert str(error.value).startswith("where = ")
