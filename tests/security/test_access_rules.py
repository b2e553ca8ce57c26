# SPDX-License-Identifier: MIT
"""Access rules: what each role may, decided as zenoh does, without a network."""

import pytest
import zenoh

from protocol.access.roles import ALWAYS, ROLES, RULING, TOUCHING, VERBS, check_identity, identity_in
from protocol.network.access_rules import ALL_MESSAGES, access_rules
from protocol.network.identity import SERVER
from sim_server.network.queryables import QUERYABLES
from sim_server.service import commands

ROLE_OF = {"eve": "viewer", "alice": "participant", "bob": "operator", "mill": "worker", "hub": "router"}
CLIENTS = ("eve", "alice", "bob")
RULES = access_rules(["sim"], ROLE_OF)


def allowed(name: str, message: str, flow: str, key: str) -> bool:
    """As zenoh decides: a rule must include the whole key expression."""
    of_subject = {rule for policy in RULES["policies"] if name in policy["subjects"] for rule in policy["rules"]}
    asked = zenoh.KeyExpr(f"warpfactor/{key}")
    return any(
        message in rule["messages"] and flow in rule["flows"]
        and any(zenoh.KeyExpr(mine).includes(asked) for mine in rule["key_exprs"])
        for rule in RULES["rules"] if rule["id"] in of_subject
    )  # fmt: skip


def test_what_is_not_allowed_is_denied() -> None:
    assert RULES["enabled"] and RULES["default_permission"] == "deny"
    assert {rule["permission"] for rule in RULES["rules"]} == {"allow"}
    assert {s["id"]: s["cert_common_names"] for s in RULES["subjects"]} == {n: [n] for n in (SERVER, *ROLE_OF)}
    ids = [rule["id"] for rule in RULES["rules"]]
    assert len(ids) == len(set(ids)) and {r for p in RULES["policies"] for r in p["rules"]} == set(ids)


def test_verbs_are_those_of_the_server() -> None:
    assert set(VERBS) == set(commands.VERBS) | {"status", "rights"}
    assert len(set(VERBS)) == len(VERBS) == len(ALWAYS) + len(TOUCHING) + len(RULING)


@pytest.mark.parametrize("verb", VERBS)
def test_a_client_sends_the_commands_of_its_role_under_its_own_name(verb: str) -> None:
    for name in CLIENTS:
        may = verb in ROLES[ROLE_OF[name]].verbs
        assert allowed(name, "query", "ingress", f"sim/command/{verb}/{name}.client-1") == may
        for other in ("bob.client-1", "client-1", "*", f"{name}", f"{name}x.client-1", "**"):
            if other.partition(".")[0] != name:
                assert not allowed(name, "query", "ingress", f"sim/command/{verb}/{other}"), (name, other)
        assert not allowed(name, "query", "ingress", f"other/command/{verb}/{name}.client-1"), "another server"
    assert not allowed("mill", "query", "ingress", f"sim/command/{verb}/mill.w1")


def test_verbs_of_the_roles() -> None:
    assert ROLES["viewer"].verbs == ALWAYS and ROLES["operator"].verbs == VERBS
    assert set(ROLES["participant"].verbs) == {*ALWAYS, *TOUCHING}
    assert not ROLES["worker"].verbs and not ROLES["router"].verbs


@pytest.mark.parametrize("name", [*CLIENTS, "mill"])
@pytest.mark.parametrize("key", ["**", "sim/**", "*/**", "sim/*", "sim/matrix/**", "sim/factor/*/*",
                                 "sim/factor/mill.w/*", "sim/pattern/**", "sim/alive/**", "sim/worker/*"])  # fmt: skip
def test_nobody_listens_to_everything_or_to_jobs_of_others(name: str, key: str) -> None:
    assert not allowed(name, "declare_subscriber", "ingress", key)


@pytest.mark.parametrize("name", [*CLIENTS, "mill"])
def test_nobody_poses_as_the_server(name: str) -> None:
    for message in ("declare_queryable", "reply"):
        for key in ("**", "sim/**", "sim/status", f"sim/command/push/{name}.c", f"sim/echo/{name}.w"):
            assert not allowed(name, message, "ingress", key)
    for key in ("sim/alive/server/*", "sim/alive/server/00000000deadbeef"):
        assert not allowed(name, "liveliness_token", "ingress", key)
    for key in ("sim/status", "sim/steps", "sim/state/beam", "sim/matrix/mill.w/beam", "sim/topology/beam"):
        assert not allowed(name, "put", "ingress", key)
        assert not allowed(name, "delete", "ingress", key)


@pytest.mark.parametrize("name", CLIENTS)
def test_a_client_looks_and_is_no_worker(name: str) -> None:
    for key in ("status", "scene", "topology/*", "topology/beam", "obstacle/*"):
        assert allowed(name, "query", "ingress", f"sim/{key}")
    for key in ("status", "steps", "reactions", "state/*", "state/beam", "pose/*"):
        assert allowed(name, "declare_subscriber", "ingress", f"sim/{key}")
        assert allowed(name, "put", "egress", f"sim/{key}")
    assert allowed(name, "query", "ingress", "sim/checkpoint") == (ROLE_OF[name] == "operator")
    assert allowed(name, "liveliness_token", "ingress", f"sim/alive/client/{name}.client-1")
    for key in ("alive/client/mill.c", "alive/client/client-1", f"alive/worker/{name}.w"):
        assert not allowed(name, "liveliness_token", "ingress", f"sim/{key}")
    for key in (
        f"factor/{name}.w/beam",
        f"pattern/{name}.w/beam",
        "factor/beam",
        f"worker/{name}.w",
        "matrix/mill.w/beam",
    ):
        assert not allowed(name, "put", "ingress", f"sim/{key}") and not allowed(name, "put", "egress", f"sim/{key}")
    assert not allowed(name, "query", "ingress", f"sim/echo/{name}.w")
    for message in ("query", "declare_queryable", "reply"):
        assert not allowed(name, message, "ingress", "sim/part/mill.w")
        assert not allowed(name, message, "ingress", f"sim/part/{name}.w")


def test_a_worker_has_the_jobs_under_its_own_names() -> None:
    for key in ("factor/mill.w1/beam", "pattern/mill.w1/beam", "worker/mill.w1"):
        assert allowed("mill", "put", "ingress", f"sim/{key}")
    assert allowed("mill", "declare_subscriber", "ingress", "sim/matrix/mill.w1/*")
    assert allowed("mill", "put", "egress", "sim/matrix/mill.w1/beam")
    assert allowed("mill", "declare_subscriber", "ingress", "*/need") and allowed("mill", "put", "egress", "sim/need")
    assert allowed("mill", "query", "ingress", "sim/echo/mill.w1")
    assert allowed("mill", "query", "egress", "sim/part/mill.w1")
    assert allowed("mill", "declare_queryable", "ingress", "sim/part/mill.w1")
    assert allowed("mill", "reply", "ingress", "sim/part/mill.w1")
    assert allowed("mill", "liveliness_token", "ingress", "sim/alive/worker/mill.w1")
    for name in ("other.w1", "mill", "w1", "*"):
        assert not allowed("mill", "declare_subscriber", "ingress", f"sim/matrix/{name}/*")
        assert not allowed("mill", "put", "egress", f"sim/matrix/{name}/beam")
        for channel in ("worker/{}", "factor/{}/beam", "pattern/{}/beam"):
            assert not allowed("mill", "put", "ingress", f"sim/{channel.format(name)}")
        for message in ("declare_queryable", "reply", "query"):
            assert not allowed("mill", message, "ingress", f"sim/part/{name}")
        assert not allowed("mill", "liveliness_token", "ingress", f"sim/alive/worker/{name}")
        assert not allowed("mill", "liveliness_token", "ingress", f"sim/alive/client/{name}")


def test_everybody_finds_servers_and_gets_answers() -> None:
    for name in (*CLIENTS, "mill"):
        assert allowed(name, "liveliness_query", "ingress", "*/alive/server/*")
        assert allowed(name, "declare_liveliness_subscriber", "ingress", "sim/alive/server/*")
        assert allowed(name, "liveliness_token", "egress", "sim/alive/server/0001")
        assert allowed(name, "reply", "egress", "sim/status")


def test_servers_and_routers_have_all_of_the_servers_and_nothing_else() -> None:
    for name in (SERVER, "hub"):
        for message in ALL_MESSAGES:
            for flow in ("ingress", "egress"):
                assert allowed(name, message, flow, "sim/**")
                assert not allowed(name, message, flow, "other/**") and not allowed(name, message, flow, "**")


def test_every_channel_that_is_answered_is_for_somebody() -> None:
    """A queryable that no rule allows would be one that nobody can use with certificates."""
    keys = {
        "command": "command/push/{0}.c",
        "topology": "topology/beam",
        "obstacle": "obstacle/o",
        "echo": "echo/{0}.w",
    }
    for channel in QUERYABLES:
        key = keys.get(channel, channel)
        assert any(allowed(name, "query", "ingress", f"sim/{key.format(name)}") for name in ROLE_OF), channel


def test_names_of_certificates_have_no_dot() -> None:
    """What follows the first dot of a client's name is free, so `bob.x` would act for `bob`."""
    assert identity_in("bob.client-1.x") == "bob" and identity_in("client-1") == ""
    for name in ("bob.x", "bob/x", "$*", "*", "", "b" * 33):
        with pytest.raises(ValueError, match="allowed: 1 to 32 characters"):
            check_identity(name, "NAME")
