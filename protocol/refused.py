# SPDX-License-Identifier: MIT
"""The one way to say that a received message must be dropped."""

from protocol.printable import printable


class Refused(ValueError):
    """A message that must be dropped; the text names message, field, value and what is allowed.

    kind is one of a few words (see below) under which receivers count refusals:
    malformed, version, incarnation, object, epoch, sequence, size, shape, not_finite, not_positive, checksum,
    pattern, slot, late, duplicate, worker, limit, secret. Keys and values of the message are shown printable.
    """

    def __init__(self, text: str, kind: str = "malformed"):
        super().__init__(printable(text))
        self.kind = kind
