# SPDX-License-Identifier: MIT
"""The live parameters of a scene as a table on a terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from clients.watch import COMPACT
from protocol import messages_pb2 as pb


def parameter_table(found: Sequence[pb.LiveParameter]) -> Table:
    """Returns a table of keys, values, units and meanings."""
    table = Table("key", "value", "unit", "about", **COMPACT)
    table.columns[0].overflow = table.columns[1].overflow = "fold"
    for each in found:
        cells = short_key(each.now.key), each.now.value, each.unit, each.about.split(", or ")[0]
        table.add_row(*map(Text, cells))
    return table


def short_key(key: str) -> str:
    """Returns a key without what the server can do without: NAME.EFFECT.KEY, EFFECT.KEY, NAME.KEY."""
    kind, _, rest = key.partition(".")
    return rest.replace(".effects.", ".", 1) if kind in ("object", "obstacle", "effects") else key
