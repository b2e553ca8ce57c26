# SPDX-License-Identifier: MIT
"""The reference of the protocol: the channels of protocol/channels.py and the messages of protocol/messages.proto."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from google.protobuf.descriptor import FieldDescriptor

from docs.site.markdown import table
from protocol import messages_pb2
from protocol.channels import CHANNELS, PROTOCOL, ROOT

PROTO = Path(messages_pb2.__file__).with_name("messages.proto")
INTRO = f"""\
# Channels and messages

All keys of the network and all messages, made from `protocol/channels.py` and `protocol/messages.proto`; logs have the
same messages. [The protocol](../protocol.md) says what is sent when, and what becomes of messages that are refused.
The protocol version is {PROTOCOL}. Arrays are little-endian, in C order.

## Channels

Keys stand under `{ROOT}/SERVER/`. Limits are in bytes: of the encoded message, and of the array beside it.

"""
TYPES = {
    value: name.removeprefix("TYPE_").lower()
    for name, value in vars(FieldDescriptor).items()
    if name.startswith("TYPE_")
}


@dataclass
class Block:
    """A message or an enum: its name, the comment before it, and rows of number, name, type, meaning."""

    name: str
    about: str
    rows: list[tuple[str, str, str, str]]


def page() -> str:
    """The whole page in Markdown."""
    rows = [
        (
            name,
            f"`{c.key}`",
            _link(c.message),
            c.sender,
            c.rate,
            f"{c.limit:,}",
            f"{c.bulk:,}" if c.bulk else "–",
            c.purpose,
        )
        for name, c in CHANNELS.items()
    ]
    head = ("channel", "key", "message", "from", "when", "limit", "array", "what")
    parts = [INTRO, table(head, rows), "\n## Messages\n\n"]
    for block in blocks():
        about = f"{_plain(block.about)}\n\n" if block.about else ""
        parts.append(f"### {block.name}\n\n{about}{table(('number', 'name', 'type', 'meaning'), block.rows)}\n")
    return "".join(parts)


def _bytes(limit: int) -> str:
    return f"{limit:,}" if limit else "–"


def _link(message: str) -> str:
    return f"[{message}](#{message.lower()})" if message else "–"


def _plain(comment: str) -> str:
    return re.sub(r"([*<>\[\]])", r"\\\1", comment)


def blocks() -> Iterator[Block]:
    """Yields the messages and enums of the protocol, in the order of the file."""
    said = comments(PROTO.read_text())
    file = messages_pb2.DESCRIPTOR
    found = {**file.message_types_by_name, **file.enum_types_by_name}
    for name in sorted(found, key=list(said).index):
        about, of = said[name]
        kind = found[name]
        fields = kind.fields if hasattr(kind, "fields") else kind.values
        yield Block(name, about, [(str(f.number), f"`{f.name}`", _type(f), _plain(of.get(f.name, ""))) for f in fields])


def comments(text: str) -> dict[str, tuple[str, dict[str, str]]]:
    """By name of message or enum: the comment before it, and those of its fields, before them or behind them."""
    found: dict[str, tuple[str, dict[str, str]]] = {}
    waiting: list[str] = []
    fields: dict[str, str] = {}
    for line in text.splitlines():
        code, _, comment = (part.strip() for part in line.partition("//"))
        if begun := re.match(r"(?:message|enum) (\w+) {", code):
            fields = {}
            found[begun[1]] = " ".join([*waiting, comment]).strip(), fields
        for name in re.findall(r"(\w+) = \d+;", code):
            fields[name] = " ".join([*waiting, comment]).strip()
        waiting = [*waiting, comment] if comment and not code else []
    return found


def _type(field: object) -> str:
    """Of a field, as the .proto file has it, with a link to a message; empty for a value of an enum."""
    if not isinstance(field, FieldDescriptor):
        return ""
    other = field.message_type or field.enum_type
    word = _link(other.name) if other else TYPES[field.type]
    if field.is_repeated:
        return f"repeated {word}"
    oneof = field.containing_oneof
    return f"optional {word}" if oneof and oneof.name == f"_{field.name}" else word
