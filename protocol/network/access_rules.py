# SPDX-License-Identifier: MIT
"""Access rules of zenoh for the names of servers and the roles of certificates. What no rule allows is denied.

A rule's `key_exprs` include what they allow: a query or subscription for more than that is denied as a whole, so that
nobody listens to `**`. zenoh compares a certificate by its common name alone, whole and without wildcards; hence one
subject for each certificate. In names of clients and workers the common name stands before the first dot, and no
common name has a dot, so that `NAME.$*` are the names of one certificate.

    ingress: what comes from the holder. egress: what goes to it
"""

from collections.abc import Mapping, Sequence
from typing import Any

from protocol.access.roles import ROLES
from protocol.channels import ROOT, key
from protocol.network.identity import SERVER

PUBLISHED = ("status", "steps", "reactions", "state", "pose")  # channels that clients may subscribe to
READ = ("status", "scene", "topology", "obstacle")  # channels that clients may query
TOPOLOGY = ("topology",)  # published to all who look


def access_rules(servers: Sequence[str], roles: Mapping[str, str]) -> dict[str, Any]:
    """Returns `access_control` of a zenoh configuration.

    servers: names in keys. roles: by common name of the certificate
    """
    rules: list[dict[str, Any]] = []
    subjects, policies = [], []
    for name, role in {SERVER: SERVER, **roles}.items():
        own = [
            {"id": f"{name} {number}", "permission": "allow", **rule}
            for number, rule in enumerate(_rules(name, role, servers), start=1)
        ]
        rules += own
        subjects.append({"id": name, "cert_common_names": [name]})
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [name]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": subjects,
        "policies": policies,
    }


ALL_MESSAGES = (
    "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable", "liveliness_token",
    "declare_liveliness_subscriber", "liveliness_query",
)  # fmt: skip


def _rules(name: str, role: str, servers: Sequence[str]) -> list[dict[str, Any]]:
    if role in (SERVER, "router"):
        everything = [f"{ROOT}/{server}/**" for server in servers]
        return [_rule(ALL_MESSAGES, ["ingress", "egress"], everything)]
    of_role = _worker(name, servers) if role == "worker" else _client(name, role, servers)
    alive = [f"{ROOT}/*/{key('alive_server', '*').split('/', 2)[2]}"]
    return [
        *of_role,
        _rule(["declare_liveliness_subscriber", "liveliness_query"], ["ingress"], alive),
        _rule(["liveliness_token"], ["egress"], alive),
        _rule(["reply", "declare_queryable"], ["egress"], [f"{ROOT}/{server}/**" for server in servers]),
    ]


def _client(name: str, role: str, servers: Sequence[str]) -> list[dict[str, Any]]:
    own = f"{name}.$*"
    verbs = ROLES[role].verbs
    reads = READ + (("checkpoint",) if "save" in verbs else ())
    return [
        _rule(["query"], ["ingress"], [key(channel, server) for server in servers for channel in reads]),
        _rule(["query"], ["ingress"], [_own("command", server, own, verb=v) for server in servers for v in verbs]),
        _rule(["liveliness_token"], ["ingress"], [_own("alive_client", server, own) for server in servers]),
        _rule(["declare_subscriber"], ["ingress"], [key(c, s) for s in servers for c in PUBLISHED + TOPOLOGY]),
        _rule(["put"], ["egress"], [key(c, s) for s in servers for c in PUBLISHED + TOPOLOGY]),
    ]


def _worker(name: str, servers: Sequence[str]) -> list[dict[str, Any]]:
    own = f"{name}.$*"

    def keys(*channels: str) -> list[str]:
        return [_own(channel, server, own) for server in servers for channel in channels]

    return [
        _rule(["put"], ["ingress"], keys("factor", "factors", "pattern", "worker")),
        _rule(["put"], ["egress"], keys("matrix", "matrices", "worker")),
        _rule(["declare_subscriber"], ["ingress"], keys("matrix", "matrices", "worker")),
        _rule(["declare_subscriber"], ["egress"], keys("factor", "factors", "pattern", "worker")),
        _rule(["declare_subscriber"], ["ingress"], [key("need", "*")]),
        _rule(["put"], ["egress"], [key("need", "*")]),
        _rule(["query"], ["ingress"], keys("topology", "scene", "echo")),
        _rule(["query"], ["egress"], keys("part")),
        _rule(["declare_queryable", "reply"], ["ingress"], keys("part")),
        _rule(["liveliness_token"], ["ingress", "egress"], keys("alive_worker")),
        _rule(["liveliness_query"], ["ingress"], keys("alive_worker")),
    ]


def _own(channel: str, server: str, own: str, verb: str = "*") -> str:
    """Returns the key of a channel with the names of a holder where it has that of a client or worker."""
    mark = "-own-"
    names = {"command": {"verb": verb, "client": mark}, "alive_client": {"client": mark}}.get(channel)
    if names is None:
        of_workers = ("matrix", "matrices", "pattern", "factor", "factors", "part", "worker", "echo", "alive_worker")
        names = {"worker": mark} if channel in of_workers else {}
    return key(channel, server, **names).replace(mark, own)


def _rule(messages: Sequence[str], flows: Sequence[str], keys: Sequence[str]) -> dict[str, Any]:
    return {"messages": list(messages), "flows": list(flows), "key_exprs": list(keys)}
