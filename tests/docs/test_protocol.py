# SPDX-License-Identifier: MIT
"""docs/protocol.md has the channels of protocol/channels.py, and docs name the limits that the code has."""

import re

import pytest

from clients.log import scalars
from protocol.channels import CHANNELS, PART_BYTES, PROTOCOL, WHOLE_PARTS, Channel
from protocol.factor import MOST_VALUES
from protocol.push_limits import LONGEST_PUSH
from protocol.shared_memory import limits
from sim_server import cli
from sim_server.mesh import MOST_TETS, skin
from sim_server.network import command_queue, factor_fetch, lease_terms, rate_limiter, worker_registry
from sim_server.recording import recorder
from sim_server.scene import integrator_options, where
from sim_server.service import commands, supervisor
from sim_server.updates import first_factors
from tests.docs.figures import DOCS, table_under

UNITS = ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB"))
NAMES = {"object": "O", "worker": "W", "client": "CLIENT", "incarnation": "INCARNATION", "verb": "VERB"}


def size(count: int) -> str:
    unit, name = next((u, n) for u, n in UNITS if count >= u)
    return f"{count // unit} {name}"


def row_of(channel: Channel) -> tuple[str, ...]:
    """What the page says of a channel."""
    key = re.sub(r"{(\w+)}", lambda m: NAMES[m[1]], channel.key)
    limit = " + ".join(size(count) for count in (channel.limit, channel.bulk) if count)
    return f"`{key}`", channel.message, channel.sender, channel.rate, limit


def test_channels() -> None:
    rows = table_under((DOCS / "protocol.md").read_text(), "The protocol")
    said = [tuple(row[c] for c in ("key under `warpfactor/NAME/`", "message", "from", "when", "limit")) for row in rows]
    assert sorted(said) == sorted(row_of(channel) for channel in CHANNELS.values())


@pytest.mark.parametrize(
    ("page", "sentence"),
    [
        ("protocol.md", f"The protocol version is {PROTOCOL}."),
        (
            "protocol.md",
            f"Each of up to {rate_limiter.CLIENTS} clients may send {rate_limiter.RATE:g} commands a second",
        ),
        ("protocol.md", f"and {rate_limiter.BURST:g} at once after a rest"),
        ("protocol.md", f"most {command_queue.CAPACITY} commands wait"),
        ("protocol.md", f"while fewer than {command_queue.MAX_DEFERRED} wait"),
        ("protocol.md", f"Of workers {worker_registry.WORKERS} are known at a time"),
        ("protocol.md", f"of names that have a token and say nothing {worker_registry.TOKENS};"),
        ("protocol.md", f"{lease_terms.LEASE_FACTOR} times what the last factorization of that object took"),
        ("protocol.md", f"({lease_terms.MIN_LEASE:g} s at least)"),
        ("protocol.md", f"has {lease_terms.MAX_LEASE:g} s."),
        ("protocol.md", f"({lease_terms.MIN_LEASE:g} to {lease_terms.MAX_LEASE:g} s,"),
        ("protocol.md", f"no new jobs after {worker_registry.SILENCE:g} s;"),
        ("protocol.md", f"at most {LONGEST_PUSH:g} s of simulation"),
        ("protocol.md", f"`ulimit -l` of {(limits.POOL_LIMIT + limits.METADATA) >> 10:,} KiB"),
        ("protocol.md", f"up to {supervisor.MAX_WORKERS} in all"),
        ("protocol.md", f"the first {scalars.MOST_READINGS:,} names of readings"),
        ("protocol.md", f"exerts on the first {scalars.MOST_REACTIONS} others"),
        ("scenes.md", f"at most {skin.MOST_VERTICES:,} vertices"),
        ("scenes.md", f"magnitude {skin.MOST_WEIGHT:g} at most"),
        ("use.md", f"up to {first_factors.TIMEOUT:g} s, before"),
        (
            "preconditioners.md",
            f"after {first_factors.TIMEOUT:g} s, or after {first_factors.WORKER_TIMEOUT:g} s in which",
        ),
        (
            "protocol.md",
            f"at most {commands.MOST_SET} parameters, keys of {commands.LONGEST_KEY} and values of "
            f"{commands.LONGEST_VALUE} characters; a server lists {commands.MOST_LISTED}.",
        ),
        ("scenes.md", f"in at most {where.MAX_LENGTH} characters and {where.MAX_DEPTH} levels"),
        ("scenes.md", f"{MOST_TETS:,} tetrahedra in all"),
        ("use.md", f"above {recorder.FRAME_BYTES >> 20} MiB"),
        ("use.md", f"above {recorder.TOTAL_BYTES >> 20} MiB all records"),
        ("use.md", f"up to {cli.WORKER_TIMEOUT:g} s"),
        ("gpu.md", f"An L of more than {MOST_VALUES:,} values"),
        ("../README.md", f"A factor of more than {MOST_VALUES:,} values"),
        ("protocol.md", f"more than {WHOLE_PARTS * PART_BYTES >> 20} MiB that has no slot"),
        ("protocol.md", f"parts, {PART_BYTES >> 20} MiB each"),
        ("protocol.md", f"asked for three times, {factor_fetch.QUESTION_TIME:g} s each"),
        ("protocol.md", f"no part has come for {factor_fetch.STALL:g} s"),
        ("protocol.md", f"The most is {MOST_VALUES:,} values"),
        ("protocol.md", f"above {lease_terms.LEASE_BLOCKS:,} of them"),
        ("scenes.md", f"is at most {integrator_options.MAX_STATES}"),
    ],
)
def test_limits(page: str, sentence: str) -> None:
    assert sentence in " ".join((DOCS / page).read_text().split())
