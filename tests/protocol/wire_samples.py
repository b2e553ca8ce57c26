# SPDX-License-Identifier: MIT
"""One message of each type with every field set to something that can be told from the others.

`python tests/protocol/wire_samples.py` prints them as hexadecimal, for wire_samples.txt, when a type is added.
A line that is there already must not change: old logs and other programs hold such bytes.
"""

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

from protocol import messages_pb2

DEPTH = 3  # messages within messages


def types() -> list[str]:
    """Every message type of the schema."""
    return sorted(messages_pb2.DESCRIPTOR.message_types_by_name)


def sample(name: str) -> Message:
    """The message of a type whose fields are filled in from their numbers."""
    message: Message = getattr(messages_pb2, name)()
    _fill(message, DEPTH)
    return message


def _fill(message: Message, depth: int) -> None:
    for field in message.DESCRIPTOR.fields:
        if field.containing_oneof is not None and field is not field.containing_oneof.fields[0]:
            continue  # only one of them may be set
        if field.type == FieldDescriptor.TYPE_MESSAGE:
            if depth > 0:
                inner = getattr(message, field.name)
                _fill(inner.add() if field.is_repeated else inner, depth - 1)
        elif field.is_repeated:
            getattr(message, field.name).extend([_value(field), _value(field)])
        else:
            setattr(message, field.name, _value(field))


def _value(field: FieldDescriptor) -> object:
    number = field.number
    return {
        FieldDescriptor.TYPE_STRING: f"{field.name}-{number}",
        FieldDescriptor.TYPE_BYTES: bytes(range(number, number + 3)),
        FieldDescriptor.TYPE_BOOL: True,
        FieldDescriptor.TYPE_DOUBLE: number + 0.25,
        FieldDescriptor.TYPE_ENUM: 2,
        FieldDescriptor.TYPE_FIXED64: 0x0123456789ABCD00 + number,
    }.get(field.type, 100 + number)


if __name__ == "__main__":
    for name in types():
        print(name, sample(name).SerializeToString(deterministic=True).hex())
