# SPDX-License-Identifier: MIT
"""The channel table and its keys."""

import pytest

from protocol import messages_pb2
from protocol.channels import CHANNELS, check_name, everything, key, name_in
from protocol.refused import Refused


def test_every_row_names_a_message_of_the_schema_and_a_limit() -> None:
    for name, channel in CHANNELS.items():
        if name.startswith("alive_"):
            assert channel.message == "" and channel.limit == 0
            continue
        message = getattr(messages_pb2, channel.message)
        assert "header" in message.DESCRIPTOR.fields_by_name, name
        assert channel.limit > 0


def test_keys_are_those_of_the_table() -> None:
    assert key("status") == "warpfactor/sim/status"
    assert key("matrix", "hub", worker="w-1", object="left.arm") == "warpfactor/hub/matrix/w-1/left.arm"
    assert key("factor") == "warpfactor/sim/factor/*/*"
    assert everything("hub") == "warpfactor/hub/**"


def test_names_are_read_back_from_keys() -> None:
    received = key("matrix", worker="w", object="o_1")
    assert (name_in("matrix", received, "worker"), name_in("matrix", received, "object")) == ("w", "o_1")


@pytest.mark.parametrize(
    "received",
    ["warpfactor/sim/factor/a", "warpfactor/sim/factor/w/", "warpfactor/sim/factor/w/a/b", "other/sim/factor/w/a", "*"],
)
def test_keys_of_another_form_are_refused(received: str) -> None:
    with pytest.raises(Refused, match="not of the form factor"):
        name_in("factor", received, "object")


@pytest.mark.parametrize("name", ["", "a" * 65, "a/b", "a*", "a b", "é", "a\n", "$x"])
def test_names_that_may_not_stand_in_a_key_are_refused(name: str) -> None:
    with pytest.raises(Refused, match=r"object name is .*allowed: 1 to 64 characters"):
        check_name(name, "object name")
    with pytest.raises(Refused):
        key("factor", object=name)


def test_a_name_that_the_channel_has_not_is_a_programming_error() -> None:
    with pytest.raises(TypeError, match="channel status has no"):
        key("status", object="a")
