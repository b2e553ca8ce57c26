# SPDX-License-Identifier: MIT
"""A file that is no log is bad input of a command."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from clients.errors import BadInput
from protocol.log_chunks import BadLog


@contextmanager
def bad_log_is_bad_input() -> Iterator[None]:
    """Turns BadLog into BadInput."""
    try:
        yield
    except BadLog as error:
        raise BadInput(str(error)) from None
