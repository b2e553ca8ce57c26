# SPDX-License-Identifier: MIT
"""Bytes on the wire and in logs stay what they are: a frozen sample of each message type."""

from pathlib import Path

import pytest
from google.protobuf.unknown_fields import UnknownFieldSet
from wire_samples import sample, types

from protocol import messages_pb2
from protocol.refused import Refused
from protocol.validate import check_header, check_numbers, check_strings, parse

LINES = (Path(__file__).parent / "wire_samples.txt").read_text().splitlines()
FROZEN = {name: bytes.fromhex(data) for name, data in (line.split() for line in LINES)}


def test_there_is_a_sample_of_every_type() -> None:
    assert sorted(FROZEN) == types()


@pytest.mark.parametrize("name", types())
def test_old_bytes_mean_what_they_meant(name: str) -> None:
    """A field may be added, but none may change its number, type or meaning."""
    old = parse(getattr(messages_pb2, name), FROZEN[name], 1 << 16)
    now = sample(name)
    for field, value in old.ListFields():
        if field.type != field.TYPE_MESSAGE:
            assert value == getattr(now, field.name), field.name
    assert old.SerializeToString(deterministic=True) == FROZEN[name]
    assert len(UnknownFieldSet(old)) == 0


@pytest.mark.parametrize("name", types())
def test_a_message_cut_anywhere_is_parsed_or_refused(name: str) -> None:
    kind, data = getattr(messages_pb2, name), FROZEN[name]
    refused = 0
    for end in range(len(data)):
        try:
            message = parse(kind, data[:end], 1 << 16)
            check_strings(message)
            check_numbers(message)
            if "header" in kind.DESCRIPTOR.fields_by_name:
                check_header(message, incarnation=1)
        except Refused:
            refused += 1
    assert refused > 0
