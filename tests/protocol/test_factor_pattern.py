# SPDX-License-Identifier: MIT
"""The supernodal pattern: what it means, and that nothing wrong gets to native code."""

import numpy as np
import pytest

from protocol.factor import FactorPattern, check_values, pattern_id
from protocol.messages_pb2 import FactorPattern as PatternMessage
from protocol.messages_pb2 import Header
from protocol.refused import Refused

# L of 5 columns in supernodes {0, 1}, {2}, {3, 4}:
#   column 0: rows 0 1 3; column 1: rows 1 3; column 2: rows 2 4; column 3: rows 3 4; column 4: row 4
GOOD = {
    "permutation": np.array([4, 2, 0, 1, 3], np.int32),
    "super_start": np.array([0, 2, 3, 5], np.int32),
    "row_start": np.array([0, 3, 5, 7], np.int64),
    "rows": np.array([0, 1, 3, 2, 4, 3, 4], np.int32),
}


def message(**changes: np.ndarray) -> PatternMessage:
    arrays = GOOD | changes
    return PatternMessage(
        header=Header(protocol=1),
        id=pattern_id(**arrays),
        size=len(arrays["permutation"]),
        supernodes=len(arrays["super_start"]) - 1,
        nonzeros=10,
        **{name: values.tobytes() for name, values in arrays.items()},
    )


def test_counts_and_diagonal() -> None:
    pattern = FactorPattern.build(**GOOD)
    assert (pattern.size, pattern.nonzeros) == (5, 10)
    assert pattern.diagonal.tolist() == [0, 3, 5, 7, 9]


def test_round_trip_through_the_message() -> None:
    pattern = FactorPattern.build(**GOOD)
    sent = pattern.message(Header(protocol=1, object="beam"))
    back = FactorPattern.from_message(PatternMessage.FromString(sent.SerializeToString()))
    assert back.id == pattern.id
    for name in GOOD:
        assert np.array_equal(getattr(back, name), getattr(pattern, name))


INT64 = np.iinfo(np.int64)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"permutation": np.array([4, 2, 0, 1, 1], np.int32)}, "twice"),
        ({"permutation": np.array([4, 2, 0, 1, 5], np.int32)}, "runs from 0 to 5"),
        ({"permutation": np.array([4, 2, 0, 1, -3], np.int32)}, "runs from -3"),
        ({"super_start": np.array([0, 2, 2, 5], np.int32)}, "super_start does not ascend"),
        ({"super_start": np.array([1, 2, 3, 5], np.int32)}, "super_start does not ascend"),
        ({"super_start": np.array([0, 2, 3, 6], np.int32)}, "super_start does not ascend"),
        ({"row_start": np.array([0, 3, 5, 8], np.int64)}, "row_start does not ascend"),
        ({"row_start": np.array([0, INT64.max, INT64.min + 4, 7], np.int64)}, "row_start does not ascend"),
        ({"row_start": np.array([0, 1, 5, 7], np.int64)}, "fewer rows than columns"),
        ({"row_start": np.array([0, 3, 5, 6, 7], np.int64)}, "bytes; allowed: int64"),
        ({"rows": np.array([0, 1, 5, 2, 4, 3, 4], np.int32)}, "rows runs from 0 to 5"),
        ({"rows": np.array([0, 2, 3, 2, 4, 3, 4], np.int32)}, "does not begin with its supernode's columns"),
        ({"rows": np.array([0, 1, 1, 2, 4, 3, 4], np.int32)}, "does not ascend strictly"),
    ],
)
def test_wrong_structure_is_refused(changes: dict[str, np.ndarray], text: str) -> None:
    with pytest.raises(Refused, match=text):
        FactorPattern.from_message(message(**changes))


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [
        ("id", 1, "not the checksum"),
        ("size", 4, "permutation has 20 bytes"),
        ("size", 0xFFFFFFFF, "permutation has 20 bytes"),
        ("supernodes", 0xFFFFFFFF, "super_start has 16 bytes"),
        ("nonzeros", 11, "nonzeros is 11; allowed: 10"),
        ("rows", b"", "rows has 0 bytes|row_start does not ascend"),
        ("permutation", b"123", "permutation has 3 bytes"),
    ],
)
def test_fields_that_do_not_fit_the_arrays_are_refused(field: str, value: object, text: str) -> None:
    wrong = message()
    setattr(wrong, field, value)
    with pytest.raises(Refused, match=text):
        FactorPattern.from_message(wrong)


def test_empty_message_is_refused() -> None:
    with pytest.raises(Refused):
        FactorPattern.from_message(PatternMessage())


def test_arrays_of_another_type_are_refused() -> None:
    arrays = GOOD | {"rows": GOOD["rows"].astype(np.int64)}
    with pytest.raises(Refused, match="rows is not a vector of int32"):
        FactorPattern(0, **arrays).check()


def test_values_of_a_factor() -> None:
    pattern = FactorPattern.build(**GOOD)
    values = np.ones(10, np.float32)
    check_values(values, pattern, None)
    with pytest.raises(Refused, match=r"shape \(9,\); allowed: float32 or float64 of shape \(10,\)"):
        check_values(values[:9], pattern, None)
    with pytest.raises(Refused, match="checksum"):
        check_values(values, pattern, 12345)
    off_diagonal, diagonal = values.copy(), values.copy()
    off_diagonal[1], diagonal[3] = -1, 0
    check_values(off_diagonal, pattern, None)
    with pytest.raises(Refused, match="diagonal entry of L is not positive"):
        check_values(diagonal, pattern, None)
