# SPDX-License-Identifier: MIT
"""Commands that arrived together: which are checked, which are replaced, and how each is answered."""

import itertools
import logging
from types import SimpleNamespace
from typing import Any

import pytest
from google.protobuf.message import DecodeError

from protocol.access.rights import Rights
from protocol.channels import PROTOCOL, key
from protocol.counters import Counters
from protocol.messages_pb2 import Command, Header, Interaction, ObstacleTarget, Reply, Vector
from protocol.refused import Refused
from sim_server.network import queryables as module
from sim_server.network.coalesce import coalesce_moves
from sim_server.network.queryables import Queryables

NAN = float("nan")


def command(verb: str, client: str = "anna", id: int = 0, x: float = 0.0, protocol: int = PROTOCOL) -> Command:
    interaction = Interaction(id=id, target=Vector(x=x))
    return Command(header=Header(protocol=protocol), client=client, verb=verb, interaction=interaction)


def moved(obstacle: str, client: str = "anna") -> Command:
    target = ObstacleTarget(obstacle=obstacle, position=Vector(x=1.0))
    return Command(header=Header(protocol=PROTOCOL), client=client, verb="move_obstacle", target=target)


def sorted_out(*commands: Command) -> tuple[list[int], list[int], list[int], list[int]]:
    """Numbers of the commands taken, refused, replaced, and of those that were checked; a target of NaN is refused."""
    checked: list[int] = []

    def check(given: Command) -> None:
        checked.append(next(n for n, c in enumerate(commands) if c is given))
        if given.interaction.target.x != given.interaction.target.x:
            raise Refused("NaN", "not_finite")

    found = coalesce_moves([(c, n) for n, c in enumerate(commands)], check)
    return [n for _, n in found.accepted], [n for _, n in found.refused], found.replaced, sorted(checked)


def test_only_the_newest_move_of_a_grab_is_checked_and_taken() -> None:
    moves = [command("move", id=7, x=float(i)) for i in range(5)]
    assert sorted_out(*moves) == ([4], [], [3, 2, 1, 0], [4])


def test_other_commands_and_other_grabs_keep_their_order() -> None:
    given = [
        command("push"), command("move", id=7), command("move", "ben", 7), command("push"), command("move", id=8),
        command("release", id=7), command("move", "ben", 7), command("move", id=7),
    ]  # fmt: skip
    assert sorted_out(*given) == ([0, 3, 4, 5, 6, 7], [], [2, 1], [0, 3, 4, 5, 6, 7])


def test_moves_of_obstacles_are_told_apart_by_obstacle_and_client() -> None:
    given = [moved("tool"), moved("spoon"), command("move", id=0), moved("tool", "ben"), moved("tool"), command("move")]
    assert sorted_out(*given) == ([1, 3, 4, 5], [], [2, 0], [1, 3, 4, 5])


def test_a_malformed_move_replaces_nothing() -> None:
    """The hand is where its last good move says, not where nobody said."""
    given = [command("move", id=7, x=1.0), command("move", id=7, x=2.0), command("move", id=7, x=NAN)]
    assert sorted_out(*given) == ([1], [2], [0], [1, 2])


def own_key(payload: bytes) -> str:
    """Key under which a command comes."""
    try:
        sent = Command.FromString(payload)
    except DecodeError:
        return key("command", "sim", verb="push", client="me")
    return key("command", "sim", verb=sent.verb, client=sent.client)


class Query:
    """As zenoh hands it over. answers: what was replied; dropped: how often."""

    def __init__(self, payload: bytes, asked: str = "command"):
        self.key_expr, self.payload = own_key(payload) if asked == "command" else asked, payload
        self.answers: list[Reply] = []
        self.dropped = 0

    def reply(self, name: str, data: bytes) -> None:
        self.answers.append(Reply.FromString(data))

    def drop(self) -> None:
        self.dropped += 1

    def __enter__(self) -> "Query":
        return self

    def __exit__(self, *_: object) -> None:
        self.drop()


@pytest.fixture
def counters() -> Counters:
    return Counters(logging.getLogger("test"))


@pytest.fixture
def queryables(counters: Counters) -> Any:
    """Queryables without a network: a posted reply is sent at once."""
    session: Any = SimpleNamespace(zenoh=SimpleNamespace(declare_queryable=lambda *_: None), thread=lambda *_: None)
    replies: Any = SimpleNamespace(post=lambda send: send() or True)
    return Queryables(session, "sim", 5, counters, None, replies, SimpleNamespace(settled=True), Rights(None))  # type: ignore[arg-type]


def test_each_of_a_round_is_answered_once(queryables: Queryables, counters: Counters) -> None:
    moves = [Query(command("move", id=7, x=float(i)).SerializeToString()) for i in range(40)]
    push, old = Query(command("push").SerializeToString()), Query(command("push", protocol=99).SerializeToString())
    broken, elsewhere = Query(b"\xff\xff"), Query(b"", key("status", "sim"))
    wrong = Query(command("move", id=7, x=NAN).SerializeToString())
    queryables.serve_all([*moves[:20], push, broken, old, elsewhere, *moves[20:], wrong], None)  # type: ignore[arg-type, list-item]
    taken = queryables.commands()
    assert [(c.verb, c.interaction.target.x) for c, _ in taken] == [("push", 0.0), ("move", 39.0)]
    assert not push.answers and not moves[-1].answers, "they are answered once they are carried out"
    for _, reply in taken:
        reply(Reply())
    everybody = [*moves, push, broken, old, wrong]
    assert [len(q.answers) for q in everybody] == [q.dropped for q in everybody] == [1] * len(everybody)
    assert all(q.answers[0].header.incarnation == 5 for q in everybody)
    assert [bool(q.answers[0].error) for q in everybody] == [False] * 41 + [True] * 3
    assert wrong.answers[0].error == "Vector.x is nan; allowed: finite"
    assert not elsewhere.answers and elsewhere.dropped == 1
    assert counters.moves_replaced == 39 and counters.refused == 3


@pytest.mark.parametrize("fails", ["parse", "check_client"])
def test_an_error_that_no_check_foresees_costs_the_others_of_a_round_nothing(
    queryables: Queryables, counters: Counters, monkeypatch: pytest.MonkeyPatch, fails: str
) -> None:
    called, sound = itertools.count(), getattr(module, fails)

    def broken(*arguments: Any) -> Any:
        if next(called) == 1:
            raise IndexError("nose")
        return sound(*arguments)

    monkeypatch.setattr(module, fails, broken)
    pushes = [Query(command("push").SerializeToString()) for _ in range(3)]
    queryables.serve_all(list(pushes), None)  # type: ignore[arg-type]
    assert len(queryables.commands()) == 2 and counters.refusals["unexpected"] == 1
    (reply,) = pushes[1].answers
    assert reply.error.startswith("a Command: IndexError: nose (test_coalesce.py:")


def test_names_of_obstacles_that_wait_are_short(queryables: Queryables) -> None:
    given = [Query(moved("n" * length).SerializeToString()) for length in (64, 65, 60_000)]
    queryables.serve_all(given, None)  # type: ignore[arg-type]
    assert [command.target.obstacle for command, _ in queryables.commands()] == ["n" * 64]
    assert "ObstacleTarget.obstacle has 65 characters; allowed: 64" in given[1].answers[0].error
