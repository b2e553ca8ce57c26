# SPDX-License-Identifier: MIT
"""Sixty and more attacks of whoever reaches the port, against a real server: no step, no answer and no factor is lost.

Each is made alone, in turn, against one server; then its log says whether all steps are there and right. By default
some of each kind are made, in a long run all.
"""

from collections.abc import Iterator

import pytest

from tests.attacks.arena import Arena, Outcome
from tests.attacks.attacks import ATTACKS, RULING, Attacker

pytestmark = pytest.mark.system

SOME = (
    "token: of a server", "token: of the client, and gone", "heartbeat: of the worker, with a huge number",
    "a worker that answers with garbage", "factor: in the worker's name, 200 numbers",
    "answers to all questions: forged ones",
    "in the server's name: steps", "command: release of another's grab", "command: under all keys",
    "command: pushes that last for ever", "questions: 3000 for the status",
    "connections: 30 sessions, one after another",
)  # fmt: skip


@pytest.fixture(scope="module", params=["bare", "viewer"])
def arena(request: pytest.FixtureRequest) -> Iterator[tuple[Arena, dict[str, Outcome]]]:
    with Arena(tls=request.param == "viewer") as one:
        found: dict[str, Outcome] = {}
        yield one, found
        judged = one.judged()
        bad = {
            name: (judged.missing(o.first, o.last), judged.wrong(o.first, o.last))
            for name, o in found.items()
            if judged.missing(o.first, o.last) or judged.wrong(o.first, o.last)
        }
        assert not bad, f"steps missing, steps wrong: {bad}"


def met(arena: tuple[Arena, dict[str, Outcome]], name: str) -> None:
    attack = ATTACKS.get(name) or RULING[name]
    outcome = arena[0].meet(attack)
    arena[1][name] = outcome
    assert (outcome.refused_honest, outcome.strangers) == (0, 0), f"{outcome}\n{arena[0].output()[-2000:]}"


def test_there_are_sixty() -> None:
    assert len(ATTACKS) >= 60 and set(SOME) <= set(ATTACKS)


@pytest.mark.parametrize("name", SOME)
def test_some_attacks(arena: tuple[Arena, dict[str, Outcome]], name: str) -> None:
    met(arena, name)


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in ATTACKS if name not in SOME])
def test_all_other_attacks(arena: tuple[Arena, dict[str, Outcome]], name: str) -> None:
    met(arena, name)


@pytest.mark.long
@pytest.mark.parametrize("name", RULING)
def test_a_viewer_does_not_rule(arena: tuple[Arena, dict[str, Outcome]], name: str) -> None:
    if not arena[0].tls:
        pytest.skip("without certificates everybody may")
    met(arena, name)


@pytest.mark.long
def test_what_a_viewer_may_not_a_bare_session_does() -> None:
    """Without certificates `stop` ends the server: so these attacks do reach it."""
    with Arena() as arena:
        bare = Attacker(arena.endpoint, arena.victim())
        RULING["command: stop"](bare)
        bare.close()
        assert arena.server.wait(30.0) == 0
