# SPDX-License-Identifier: MIT
"""Key figures of every run of a benchmark, a line of JSON each, and what moved since the run before.

    deploy/run bench --compare

A run is compared with the last one before it of the same benchmark, machine and arguments.
"""

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

FILE = Path(__file__).resolve().parents[3] / "docs" / "bench" / "history.jsonl"
LIMIT = 0.1  # relative change that is told
Entry = dict[str, Any]


def figures(rows: Sequence[dict[str, Any]], names: Sequence[str], values: Sequence[str]) -> dict[str, float]:
    """Numbers of a table by name, as {"540, async + warp: CPU ms": 0.21}.

    names: columns that tell rows apart, none for a single row; values: columns that hold the numbers. What is unknown
    is left out.
    """
    found = {}
    for row in rows:
        label = ", ".join(str(row[name]) for name in names)
        for value in values:
            if (number := row.get(value)) is not None and math.isfinite(number):
                found[f"{label}: {value}" if label else value] = float(number)
    return found


def entry(bench: str, header: dict[str, Any], arguments: dict[str, Any], found: dict[str, float]) -> Entry:
    """A line of the history. header: of a report; numbers keep four digits."""
    machine = header["machine"]
    gpu = f", {machine['gpu']}" if machine.get("gpu") else ""
    return {
        "bench": bench,
        "date": header["date"],
        "commit": header["commit"],
        "machine": f"{machine['cpu']}, {machine['cores']} cores{gpu}",
        "arguments": arguments,
        "figures": {name: float(f"{number:.4g}") for name, number in found.items()},
    }


def read(file: Path = FILE) -> list[Entry]:
    """All entries, the oldest first."""
    return [json.loads(line) for line in file.read_text().splitlines() if line] if file.exists() else []


def append(new: Entry, file: Path = FILE) -> None:
    """Adds a line, unless it is there: pieces may be merged more than once."""
    if new not in read(file):
        with file.open("a") as out:
            out.write(json.dumps(new, allow_nan=False, ensure_ascii=False) + "\n")


def pairs(entries: Sequence[Entry]) -> Iterator[tuple[Entry | None, Entry]]:
    """For each benchmark, machine and arguments: the last entry but one, None if there is none, and the last."""
    last: dict[str, list[Entry]] = {}
    for one in entries:
        key = json.dumps([one["bench"], one["machine"], one["arguments"]], sort_keys=True)
        last[key] = [*last.get(key, []), one][-2:]
    for found in last.values():
        yield (found[0] if len(found) == 2 else None), found[-1]


def moved(before: Entry, now: Entry) -> list[str]:
    """A line for each figure that changed by more than LIMIT, appeared or is gone."""
    old, new = before["figures"], now["figures"]
    lines = []
    for name in [*old, *(name for name in new if name not in old)]:
        if name not in old or name not in new:
            lines.append(f"  {name}: {'gone' if name in old else f'new, {new[name]:g}'}")
        elif abs(new[name] - old[name]) > LIMIT * abs(old[name]):
            change = f" ({new[name] / old[name] - 1:+.0%})" if old[name] else ""
            lines.append(f"  {name}: {old[name]:g} -> {new[name]:g}{change}")
    return lines


def compared(entries: Sequence[Entry]) -> str:
    """What --compare prints."""
    lines = []
    for before, now in pairs(entries):
        head = f"{now['bench']}, {now['machine']}, {now['commit']} ({now['date'][:10]})"
        if before is None:
            lines.append(f"{head}: nothing to compare with")
            continue
        found = moved(before, now)
        what = f"{len(found) or 'no'} figures moved by more than {LIMIT:.0%}"
        lines += [f"{head} against {before['commit']} ({before['date'][:10]}): {what}", *found]
    return "\n".join(lines or ["no benchmark has left figures yet"])


if __name__ == "__main__":
    print(compared(read()))
