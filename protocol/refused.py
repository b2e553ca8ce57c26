# SPDX-License-Identifier: MIT
"""The error of a received message that must be dropped."""

from protocol.printable import printable


class Refused(ValueError):
    """A message that must be dropped; the text names message, field, value and what is allowed.

    kind: by which receivers count refusals, one of
    malformed, version, incarnation, object, epoch, sequence, size, shape, not_finite, not_positive, checksum,
    pattern, slot, late, duplicate, memory, worker, limit, secret, role, key, unexpected (Counters.unexpected).
    place: of an unexpected one: type of the error and the line that raised it

    Keys and values of the message are shown printable.
    """

    def __init__(self, text: str, kind: str = "malformed", place: str = ""):
        super().__init__(printable(text))
        self.kind, self.place = kind, place
