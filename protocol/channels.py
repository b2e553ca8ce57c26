# SPDX-License-Identifier: MIT
"""Every channel in one table: key, message, sender, rate, size limits, purpose. docs/protocol.md shows it."""

import re
from dataclasses import dataclass

from protocol.refused import Refused

PROTOCOL = 2  # wire version; grows when a message changes its meaning or its key
OLDEST_LOG = 1  # wire version of the oldest logs that are read; their messages mean what they did
ROOT = "warpfactor"
SERVER_NAME = "sim"
DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"  # loopback: a server listens on other interfaces only when asked

MOST_JOBS = 256  # in flight at one worker, of small objects

KIB, MIB, GIB = 1 << 10, 1 << 20, 1 << 30

PART_BYTES = 4 * MIB  # of a part of a factor: smaller ones cost more time for each byte, larger ones hold others up
WHOLE_PARTS = 4  # a factor of at most so many parts travels whole
WHOLE_BYTES = WHOLE_PARTS * PART_BYTES


@dataclass(frozen=True)
class Channel:
    """One row. limit bounds the encoded message, bulk the array that travels beside it (0: none), in bytes."""

    key: str
    message: str
    sender: str
    rate: str
    limit: int
    bulk: int
    purpose: str


# A message with bulk travels as attachment, the array as payload or in a slot of shared memory.
CHANNELS: dict[str, Channel] = {
    "status": Channel("status", "Status", "server", "1 Hz, queryable", MIB, 0, "health of the whole scene"),
    "scene": Channel("scene", "Scene", "server", "queryable", 4 * MIB, 0, "what is being simulated"),
    "topology": Channel(
        "topology/{object}", "Topology", "server", "once per epoch, queryable", 256 * MIB, 0, "mesh, pattern of A"
    ),
    "checkpoint": Channel(
        "checkpoint", "Checkpoint", "server", "queryable", 256 * MIB, 0, "the state that was saved last"
    ),
    "matrix": Channel("matrix/{worker}/{object}", "Matrix", "server", "one in flight per object", 64 * KIB, GIB, "job"),
    "matrices": Channel(
        "matrices/{worker}", "MatrixBatch", "server", "as workers take them", 64 * KIB, GIB, "jobs of small objects"
    ),
    "pattern": Channel(
        "pattern/{worker}/{object}", "FactorPattern", "worker", "when it is new", 256 * MIB, 0, "pattern of L"
    ),
    "factor": Channel(
        "factor/{worker}/{object}", "Factor", "worker", "one per matrix", 64 * KIB, WHOLE_BYTES, "values of L"
    ),
    "factors": Channel(
        "factors/{worker}", "FactorBatch", "worker", "one or several for each MatrixBatch", 512 * KIB, 0, "values of L"
    ),
    "part": Channel(
        "part/{worker}", "FactorPart", "worker", "query, of large factors", 4 * KIB, PART_BYTES, "part of values of L"
    ),
    "worker": Channel("worker/{worker}", "WorkerInfo", "worker", "5 Hz", 16 * KIB, 0, "hello, then heartbeat"),
    "need": Channel("need", "Need", "server", "2 Hz", KIB, 0, "what more workers are worth to it"),
    "echo": Channel("echo/{worker}", "Echo", "worker", "query, at join", 4 * KIB, 0, "does shared memory work?"),
    "steps": Channel("steps", "Steps", "server", "20 Hz batches", 8 * MIB, 0, "iterations, residuals, times"),
    "reactions": Channel(
        "reactions", "Steps", "server", "each millisecond", MIB, 0, "forces of each step, for force feedback"
    ),
    "state": Channel("state/{object}", "State", "server", "at most 30 Hz", 256 * MIB, 0, "positions, velocities"),
    "obstacle": Channel("obstacle/{object}", "Obstacle", "server", "queryable", 256 * MIB, 0, "shape, where it starts"),
    "pose": Channel("pose/{object}", "ObstaclePose", "server", "at most 30 Hz", 4 * KIB, 0, "where it is now"),
    "command": Channel("command/{verb}/{client}", "Command", "client", "query", 64 * KIB, 0, "push, grab, pause, ..."),
    "reply": Channel("command/{verb}/{client}", "Reply", "server", "per command", MIB, 0, "what became of a command"),
    "alive_server": Channel("alive/server/{incarnation}", "", "server", "liveliness", 0, 0, "the server lives"),
    "alive_worker": Channel("alive/worker/{worker}", "", "worker", "liveliness", 0, 0, "a worker lives"),
    "alive_client": Channel("alive/client/{client}", "", "client", "liveliness", 0, 0, "a client lives"),
}

FORMER_COMMAND = "command"  # key of all verbs in older clients, which are told to be renewed

_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")


def check_name(name: str, what: str) -> str:
    """The name itself if it may stand in a key; raises Refused (a ValueError) otherwise."""
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        shown = repr(name[:80]) if isinstance(name, str) else type(name).__name__
        raise Refused(f"{what} is {shown}; allowed: 1 to 64 characters of A-Z a-z 0-9 _ . -", "malformed")
    return name


def key(channel: str, server: str = SERVER_NAME, **names: str) -> str:
    """Key of a channel, for example key("matrix", worker="w1", object="beam"); "*" stands for any name.

    A name that is left out is any name too, and server "*" any server.
    """
    template = CHANNELS[channel].key
    fields = re.findall(r"{(\w+)}", template)
    unknown = set(names) - set(fields)
    if unknown:
        raise TypeError(f"channel {channel} has no {sorted(unknown)}; it has {fields}")
    filled = {field: names.get(field, "*") for field in fields}
    for field, name in filled.items():
        if name != "*":
            check_name(name, f"{field} name")
    if server != "*":
        check_name(server, "server name")
    return f"{ROOT}/{server}/{template.format(**filled)}"


def commands(server: str = SERVER_NAME) -> str:
    """What the keys of all commands to a server begin with."""
    return f"{ROOT}/{check_name(server, 'server name')}/command/"


def everything(server: str = SERVER_NAME) -> str:
    """Key expression that takes in all channels of a server."""
    return f"{ROOT}/{check_name(server, 'server name')}/**"


def server_in(key_expression: object) -> str:
    """The server that a received key belongs to; raises Refused if it is no key of ours."""
    root, _, rest = str(key_expression).partition("/")
    if root != ROOT:
        raise Refused(f"key {str(key_expression)[:200]!r} does not begin with {ROOT}/", "malformed")
    return check_name(rest.partition("/")[0], "server name in a key")


def name_in(channel: str, key_expression: object, field: str) -> str:
    """The object, worker, client or incarnation that a received key names; raises Refused if it names none."""
    template = CHANNELS[channel].key
    pattern = re.escape(template).replace(r"\{", "{").replace(r"\}", "}")
    pattern = re.sub(r"{(\w+)}", r"(?P<\1>[^/*]+)", pattern)
    match = re.fullmatch(rf"{ROOT}/[^/]+/{pattern}", str(key_expression))
    if match is None:
        raise Refused(f"key {str(key_expression)[:200]!r} is not of the form {template}", "malformed")
    return check_name(match.group(field), f"{field} name in a key")
