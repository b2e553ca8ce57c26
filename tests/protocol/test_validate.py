# SPDX-License-Identifier: MIT
"""Checks of untrusted messages."""

import math

import numpy as np
import pytest

from protocol import validate
from protocol.channels import PROTOCOL
from protocol.messages_pb2 import Command, Factor, Header, Interaction, Vector, WorkerInfo
from protocol.refused import Refused
from protocol.validate import (
    CHUNK,
    all_finite,
    array,
    check_header,
    check_numbers,
    check_strings,
    checksum,
    copied,
    parse,
    take,
)


class Huge:
    """A payload that must not be copied."""

    def __len__(self) -> int:
        return 1 << 40

    def __bytes__(self) -> bytes:
        raise AssertionError("copied before its size was looked at")


def test_size_is_looked_at_before_anything_is_copied() -> None:
    with pytest.raises(Refused, match=r"Factor has 1099511627776 bytes; allowed: at most 100") as refused:
        parse(Factor, Huge(), 100)
    assert refused.value.kind == "size"
    with pytest.raises(Refused, match="payload is missing"):
        take(None, 10, "payload")


def test_garbage_is_refused() -> None:
    with pytest.raises(Refused, match="Factor of 4 bytes is not a valid message"):
        parse(Factor, b"\xff\xff\xff\xff", 100)


def header(**changes: object) -> Header:
    fields = {"protocol": PROTOCOL, "incarnation": 7, "object": "beam", "epoch": 2, "sequence": 5} | changes
    return Header(**fields)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("changes", "kind", "text"),
    [
        ({"protocol": PROTOCOL + 1}, "version", rf"Factor.header.protocol is {PROTOCOL + 1}; allowed: {PROTOCOL}"),
        ({"protocol": 0}, "version", "Factor.header.protocol is 0"),
        ({"incarnation": 8}, "incarnation", "Factor.header.incarnation is 0000000000000008; allowed: 0000000000000007"),
        ({"object": "liver"}, "object", "Factor.header.object is 'liver'; allowed: beam"),
        ({"object": "a/b"}, "malformed", "Factor.header.object is 'a/b'; allowed: 1 to 64"),
        ({"epoch": 1}, "epoch", "Factor.header.epoch is 1; allowed: 2"),
        ({"sequence": 4}, "sequence", "Factor.header.sequence is 4; allowed: more than 4"),
    ],
)
def test_headers_that_do_not_fit_are_refused(changes: dict[str, object], kind: str, text: str) -> None:
    expected = {"incarnation": 7, "object": {"beam": 1}, "epoch": 2, "after": 4}
    check_header(Factor(header=header()), **expected)  # type: ignore[arg-type]
    with pytest.raises(Refused, match=text) as refused:
        check_header(Factor(header=header(**changes)), **expected)  # type: ignore[arg-type]
    assert refused.value.kind == kind


def test_a_message_without_a_header_is_refused() -> None:
    with pytest.raises(Refused, match="protocol is 0"):
        check_header(Factor())


def test_arrays_have_the_shape_asked_for() -> None:
    values = np.arange(12.0).reshape(4, 3)
    assert np.array_equal(array(values.tobytes(), np.float64, (4, 3), "x"), values)
    assert np.array_equal(array(values.tobytes(), np.float64, (-1, 3), "x"), values)
    for data in (values.tobytes()[:-1], b"", values.tobytes() + b"\0" * 8):
        with pytest.raises(Refused, match=r"State.x has \d+ bytes; allowed: float64 of shape \(4, 3\), 96 bytes"):
            array(data, np.float64, (4, 3), "State.x")


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_values_that_are_not_finite_are_found_wherever_they_stand(bad: float) -> None:
    for place in (0, 300_000, -1):
        values = np.zeros(600_001)
        values[place] = bad
        with pytest.raises(Refused, match="NaN or infinite"):
            array(values.tobytes(), np.float64, (-1,), "x", finite=True)
    deep = Command(interaction=Interaction(force=Vector(y=bad)))
    with pytest.raises(Refused, match=r"Vector.y is"):
        check_numbers(deep)


def test_long_texts_are_refused() -> None:
    check_strings(WorkerInfo(host="h" * 256), 256)
    with pytest.raises(Refused, match=r"WorkerInfo.host has 257 characters; allowed: 256"):
        check_strings(WorkerInfo(host="h" * 257), 256)


def test_checksum_is_that_of_the_bytes_and_notices_one_bit() -> None:
    values = np.linspace(0, 1, 1000)
    assert checksum(values) == checksum(values.tobytes()) == checksum(values.reshape(10, 100))
    changed = values.copy()
    changed.view(np.uint8)[4321] ^= 1
    assert checksum(changed) != checksum(values)


@pytest.mark.parametrize("size", [0, 1, CHUNK, CHUNK + 1, 3 * CHUNK - 1])
@pytest.mark.parametrize("bad", [None, math.nan, -math.inf])
def test_one_pass_copies_and_tells_what_two_more_would(size: int, bad: float | None) -> None:
    source = np.random.default_rng(size).standard_normal(size).astype(np.float32)
    if bad is not None and size:
        source[-1] = bad
    target = np.zeros_like(source)
    assert copied(source, target, own=target) == (checksum(source), all_finite(source))
    assert target.tobytes() == source.tobytes()


@pytest.mark.parametrize("helpers", [0, 1, 3])
@pytest.mark.parametrize("bad", [None, 0, -1])
def test_threads_that_help_change_nothing(monkeypatch: pytest.MonkeyPatch, helpers: int, bad: int | None) -> None:
    monkeypatch.setattr(validate, "PIECE", 1000)
    monkeypatch.setattr(validate, "ALONE", 0)
    monkeypatch.setattr(validate, "helping_threads", lambda: helpers)
    source = np.random.default_rng(1).standard_normal(12_345).astype(np.float32)
    if bad is not None:
        source[bad] = np.inf
    target = np.zeros_like(source)
    for own in (source, target):
        assert copied(source, target, own) == (checksum(source), bad is None)
        assert target.tobytes() == source.tobytes()


def test_what_is_told_is_about_the_own_values() -> None:
    """The other array is shared: what another process writes there in the meantime must not be told as ours."""

    class Shared(np.ndarray):
        """Changes as soon as it is written to."""

        def __getitem__(self, place: object) -> np.ndarray:
            return np.full(len(range(*place.indices(len(self)))), 7, np.float32)  # type: ignore[attr-defined]

    source = np.arange(100, dtype=np.float32)
    assert copied(source, np.zeros(100, np.float32).view(Shared), own=source)[0] == checksum(source)
