# SPDX-License-Identifier: MIT
"""The option --at: three coordinates as three words, or the name of a point as one."""

from __future__ import annotations

import re
from typing import Any

from typer.core import TyperCommand

from clients.errors import BadInput

AT_HELP = (
    "Where: X Y Z in the world as it is now, m, or a point of the object: tip (the free node farthest from what is "
    "fixed), top, bottom, left, right, front, back."
)
_NUMBER = re.compile(r"[-+]?(\d|\.\d|inf|nan)", re.IGNORECASE)


class PointCommand(TyperCommand):
    """A command whose option --at may be followed by one word or three numbers."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Joins the three numbers after --at to one word, then parses as typer does."""
        joined: list[str] = []
        while args:
            joined.append(args.pop(0))
            if joined[-1] == "--at" and args and _NUMBER.match(args[0]):
                count = next((i for i, word in enumerate(args[:3]) if word.startswith("--")), 3)
                joined.append(" ".join(args[:count]))
                del args[:count]
        return super().parse_args(ctx, joined)


def point(text: str) -> str | tuple[float, float, float]:
    """Parses coordinates, or the name of a point, which the server resolves. Raises BadInput."""
    words = text.replace(",", " ").split()
    if len(words) == 1 and not _NUMBER.match(words[0]):
        return words[0]
    try:
        x, y, z = map(float, words)
    except ValueError:
        raise BadInput(f"--at {text}: allowed are three numbers X Y Z, or one name such as tip or top") from None
    return x, y, z
