# SPDX-License-Identifier: MIT
"""Shows an explanation in tables."""

from collections.abc import Iterable

from rich.console import Console, Group
from rich.table import Table
from rich.text import Text

from sim_server.explain.explanation import BESIDE, Asked, Explanation

WIDTH = 120
NONE, ASKER = "-", "first asked for by"


def tables(found: Explanation) -> Group:
    """Returns the tables: launches, and by who asked for it kernels, memory, network, log and modules; totals."""
    parts = [_launches(found), _kernels(found)]
    told = (_listed(found, "key of the network", "network"), _listed(found, "channel of the log", "log"))
    parts += [*told, _modules(found), _sums(found)]
    lines: list[Text | Table] = [Text(f"{found.scene}, {found.device}; no step was made")]
    for part in parts:
        lines += [Text(), part]
    if found.device == "gpu":
        lines += [Text(), Text("On a GPU launches over the same items of a domain are put together in one kernel.")]
    return Group(*lines)


def _table(*columns: str, right: Iterable[str] = ()) -> Table:
    table = Table(box=None, pad_edge=False)
    for name in columns:
        table.add_column(name, justify="right" if name in right else "left", overflow="fold")
    return table


def _launches(found: Explanation) -> Table:
    table = _table("launch", "kernel", "domain", "items", "when", ASKER, right=("launch", "items"))
    number = 0
    for row in found.launches:
        number += row.when not in BESIDE
        shown = "" if row.when in BESIDE else str(number)
        table.add_row(shown, row.kernel, row.domain or NONE, str(row.items), row.when, row.asker)
    return table


def _kernels(found: Explanation) -> Table:
    table = _table("kernel text", "kernels", ASKER)
    for each in found.asked:
        for text, names in each.kernels.items():
            table.add_row(text, ", ".join(names), each.name)
        for text in each.native:
            table.add_row(text, "native code", each.name)
    return table


def _listed(found: Explanation, what: str, attribute: str) -> Table:
    table = _table(what, ASKER)
    for each in found.asked:
        for name in getattr(each, attribute):
            table.add_row(name, each.name)
    return table


def _modules(found: Explanation) -> Table:
    table = _table("imported module", ASKER)
    for each in found.asked[1:]:
        for name in each.modules:
            table.add_row(name, each.name)
    table.add_row(f"{len(found.asked[0].modules)} of ours, {found.others} of others", found.asked[0].name)
    return table


def _sums(found: Explanation) -> Table:
    numbers = ["modules", "texts", "kernels", "launches", "arrays", "bytes", "on the GPU", "keys", "channels"]
    if found.device != "gpu":
        numbers.remove("on the GPU")
    table = _table(ASKER, *numbers, right=numbers)
    for each in found.asked:
        table.add_row(each.name, *_numbers(each, found.device))
    t = found.totals
    last = [t[name] for name in ("modules", "texts", "kernels", "launches", "arrays", "bytes", "device_bytes")]
    last += [t["network"], t["log"]]
    if found.device != "gpu":
        last.pop(6)
    table.add_row("total", *(f"{n:,}" for n in last), style="bold")
    return table


def _numbers(each: Asked, device: str) -> list[str]:
    kernels = sum(len(names) for names in each.kernels.values())
    found = [len(each.modules), len(each.kernels) + len(each.native), kernels, each.launches, each.arrays, each.bytes]
    found += [each.device_bytes] if device == "gpu" else []
    return [f"{n:,}" for n in (*found, len(each.network), len(each.log))]


def show(found: Explanation) -> None:
    """Prints the tables."""
    console = Console()
    if not console.is_terminal:
        console.width = max(console.width, WIDTH)  # a file has no edge
    console.print(tables(found))
