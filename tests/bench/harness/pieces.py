# SPDX-License-Identifier: MIT
"""A benchmark cut into pieces: each leaves its JSON as it goes, and several become one page, on any machine."""

import argparse
import json
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from tests.bench.harness.report import Report, plain

Row = dict[str, Any]


def arguments_of_pieces(parser: argparse.ArgumentParser) -> None:
    """--limit and --merge."""
    parser.add_argument(
        "--limit", type=float, metavar="SECONDS", help="begin nothing new after so long; says what is left"
    )
    parser.add_argument("--merge", type=Path, nargs="+", metavar="JSON", help="only make one page of these results")
    parser.add_argument("--out", type=Path)


class Piece(Report):
    """A report whose JSON is there after each row, should the run be cut off."""

    def keep(self) -> None:
        """NAME.json as it is now; the calibration of the end is still missing."""
        header = self.head() | {"calibration": {"before": self._before, "after": self._before}}
        self.save(header)


class Merged(Report):
    """A report of several pieces; its head is that of the last, and it shows which there were."""

    def __init__(self, name: str, title: str, files: Sequence[Path], out: Path | None):
        self.parts = [json.loads(file.read_text()) for file in files]
        last, several = self.parts[-1], len(self.parts) > 1
        super().__init__(name, title, {"pieces": len(files)} if several else last["arguments"], out, quick=True)
        self._given, self.quick = last["header"], bool(last["arguments"].get("quick"))
        if several:
            self.say("Put together of several runs, the last one described above:")
            told = [{"run": number, **_told(part)} for number, part in enumerate(self.parts, 1)]
            self.table(told, list(dict.fromkeys(name for row in told for name in row)))

    def header(self) -> Row:
        """As given."""
        return self._given

    def rows(self, section: str, names: Sequence[str]) -> list[Row]:
        """Of all pieces; where two have the same row (by these names), that of the later one."""
        found = {tuple(row.get(n) for n in names): row for part in self.parts for row in part["data"].get(section, [])}
        return list(found.values())


def _told(part: Row) -> Row:
    header, words = part["header"], {}
    for name, value in part["arguments"].items():
        words[name] = " ".join(map(str, value)) if isinstance(value, list) else str(value)
    where = {name: header["machine"].get(name) for name in ("cpu", "cores", "gpu", "load")}
    return {**{k: header[k] for k in ("date", "commit")}, **where, **words}


class Limit:
    """The time that a piece may take. seconds: None for no end."""

    def __init__(self, seconds: float | None):
        self._begun, self._seconds = time.monotonic(), seconds
        self.left_out: list[str] = []

    def reached(self, what: str) -> bool:
        """Whether `what` is not to be begun any more; then it is noted."""
        over = self._seconds is not None and time.monotonic() - self._begun > self._seconds
        if over:
            self.left_out.append(what)
        return over

    def tell(self) -> None:
        """What was left out."""
        if self.left_out:
            say(f"left out after {self._seconds:g} s: {', '.join(self.left_out)}")


def say(text: str) -> None:
    """Progress, at once."""
    print(text, flush=True)


def shown(row: Row, names: Iterable[str] = ()) -> str:
    """A row on one line; names: these alone."""
    kept = {k: v for k, v in row.items() if not names or k in names}
    return ", ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in plain(kept).items())
