# SPDX-License-Identifier: MIT
"""Texts that came over the network do nothing to the terminal that shows them."""

import pytest

from protocol import messages_pb2 as pb
from protocol.printable import printable
from protocol.refused import Refused
from protocol.validate import parse

EVIL = "\x1b]0;PWNED\x07\x1b[31m red\r\nsim-server: all is well\x7f\u202e\x9b2J\u2028"


@pytest.mark.parametrize("text", ["", "cholmod 3.0.14", "µ-Rechner, Größe 3 m²", "C:\\x1b"])
def test_what_can_be_shown_stays(text: str) -> None:
    assert printable(text) == text


def test_what_a_terminal_would_obey_is_shown_as_an_escape_sequence() -> None:
    shown = printable(EVIL)
    assert shown.isprintable()
    assert shown == r"\x1b]0;PWNED\x07\x1b[31m red\r\nsim-server: all is well\x7f\u202e\x9b2J\u2028"


def test_all_texts_of_a_message_are_printable_once_it_is_parsed() -> None:
    status = pb.Status(
        scene=EVIL,
        clients=["good", EVIL],
        workers=[pb.WorkerInfo(worker="w", host=EVIL, library=EVIL)],
        objects=[pb.ObjectStatus(object=EVIL, last=pb.ObjectStep(preconditioner=EVIL))],
    )
    found = parse(pb.Status, status.SerializeToString(), 1 << 20)
    texts = [found.scene, *found.clients, found.workers[0].host, found.workers[0].library, found.objects[0].object]
    assert all(text.isprintable() for text in [*texts, found.objects[0].last.preconditioner])
    assert found.clients[0] == "good" and "PWNED" in found.scene


def test_documents_keep_their_lines() -> None:
    scene = pb.Scene(name="a\nb", toml="dt = 1\n[effects]\n", resolved='{"dt":\n1}')
    found = parse(pb.Scene, scene.SerializeToString(), 1 << 20)
    assert (found.name, found.toml, found.resolved) == (r"a\nb", scene.toml, scene.resolved)


def test_a_refusal_shows_the_key_and_the_value_printable() -> None:
    assert str(Refused(f"its key is {EVIL}")).isprintable()
