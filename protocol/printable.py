# SPDX-License-Identifier: MIT
"""Untrusted text made printable: control and invisible characters become escape sequences."""

from functools import cache

from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import Message

DOCUMENTS = {"warpfactor.Scene.toml", "warpfactor.Scene.resolved"}  # files of several lines, which are never printed


def printable(text: str) -> str:
    """Returns the text with control characters, line breaks and invisible characters as \\x1b, \\n, \\u202e."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)


def make_printable(message: Message) -> None:
    """Makes every text of a message, and of messages in it, printable, except DOCUMENTS."""
    for name, repeated, nested in _fields(message.DESCRIPTOR):
        value = getattr(message, name)
        if not nested:
            if repeated:
                if not all(text.isprintable() for text in value):
                    value[:] = [printable(text) for text in value]
            elif not value.isprintable():
                setattr(message, name, printable(value))
        elif repeated:
            for item in value:
                make_printable(item)
        elif message.HasField(name):
            make_printable(value)


@cache
def _fields(kind: Descriptor) -> tuple[tuple[str, bool, bool], ...]:
    """Returns (name, repeated, message) of the fields that are or contain texts."""
    text, message = FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_MESSAGE
    return tuple(
        (field.name, field.is_repeated, field.type == message)
        for field in kind.fields
        if (field.type == text and field.full_name not in DOCUMENTS)
        or (field.type == message and _fields(field.message_type))
    )
