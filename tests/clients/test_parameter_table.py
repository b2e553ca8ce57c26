# SPDX-License-Identifier: MIT
"""The table of parameters that may change while a scene runs."""

from io import StringIO

import pytest
from rich.console import Console

from clients.watch import parameter_table
from protocol import messages_pb2 as pb


def shown(key: str) -> str:
    about = "Poisson's ratio, of every element whose region gives none"
    found = [pb.LiveParameter(now=pb.Parameter(key=f"object.{key}", value="[0.0, 0.45, 0.0]"), unit="-", about=about)]
    text = StringIO()
    Console(width=80, file=text).print(parameter_table(found))
    return text.getvalue()


@pytest.mark.parametrize("key", ["beam.corotational.poisson", "liver.effects.rayleigh.stiffness"])
def test_keys_are_whole_on_a_narrow_terminal(key: str) -> None:
    assert key.replace(".effects", "") in shown(key)


def test_a_long_key_leaves_room_for_the_rest() -> None:
    text = shown("a" * 200)
    assert "0.45" in text and "Poisson" in text and text.count("aaaa") >= 50
    assert max(map(len, text.splitlines())) <= 80
