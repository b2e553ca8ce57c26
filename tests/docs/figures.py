# SPDX-License-Identifier: MIT
"""Fills measured figures into README.md and docs/*.md from the tables of the pages under docs/bench.

A benchmark writes its page from its JSON; nothing else holds a measured number. Where prose needs one, a mark says
which::

    <!-- figure PAGE | HEADING | ROWS | COLUMN -->74.9<!-- /figure -->
    <!-- table PAGE | HEADING | ROWS | COLUMN; COLUMN as TITLE; ... -->
    <!-- /table -->

PAGE is a path below docs; the first table under HEADING is meant. ROWS is "-" for all or COLUMN=VALUE, COLUMN=VALUE; a
figure needs exactly one row. Run as a module it rewrites what stands between the marks.
"""

import re
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
MARK = re.compile(r"(<!-- (figure|table) ([^|]+?) \| ([^|]+?) \| ([^|]+?) \| (.+?) -->)(.*?)(<!-- /\2 -->)", re.DOTALL)

Row = dict[str, str]


class BadMark(Exception):
    """A mark that names nothing: page, heading, column or row."""


def texts() -> list[Path]:
    """The documents that people write: README, CONTRIBUTING and docs, without the pages of benchmarks."""
    pages = [path for folder in (DOCS, DOCS / "site", DOCS / "tutorials") for path in sorted(folder.glob("*.md"))]
    return [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *pages]


def cells(line: str) -> list[str]:
    """The cells of one line of a Markdown table."""
    return [cell.strip().replace(r"\|", "|") for cell in re.split(r"(?<!\\)\|", line.strip())[1:-1]]


def table_under(text: str, heading: str) -> list[Row]:
    """Rows of the first table under a heading; raises BadMark if there is none."""
    found = re.search(rf"^#+ {re.escape(heading)}$(.*?)(?=^#|\Z)", text, re.MULTILINE | re.DOTALL)
    lines = [line for line in found[1].splitlines() if line.startswith("|")] if found else []
    if len(lines) < 3:
        raise BadMark(f"no table under the heading {heading!r}")
    head, _, *_ = lines
    body = found[1].split(head, 1)[1].splitlines()[2:]  # type: ignore[index]  # lines come from found
    names = cells(head)
    rows = []
    for line in body:
        if not line.startswith("|"):
            break
        rows.append(dict(zip(names, cells(line), strict=True)))
    return rows


def chosen(rows: Iterable[Row], condition: str) -> list[Row]:
    """Rows that satisfy COLUMN=VALUE, COLUMN=VALUE; "-" keeps all."""
    rows = list(rows)
    for part in [] if condition == "-" else condition.split(", "):
        column, _, value = part.partition("=")
        rows = [row for row in rows if cell(row, column) == value]
    if not rows:
        raise BadMark(f"no row with {condition}")
    return rows


def cell(row: Row, column: str) -> str:
    """One cell; raises BadMark if the table has no such column."""
    if column not in row:
        raise BadMark(f"no column {column!r}; there are {', '.join(row)}")
    return row[column]


def content(kind: str, page: str, heading: str, condition: str, columns: str) -> str:
    """What belongs between the marks."""
    path = DOCS / page
    if not path.exists():
        raise BadMark(f"no page {path}")
    rows = chosen(table_under(path.read_text(), heading), condition)
    if kind == "figure":
        if len(rows) != 1:
            raise BadMark(f"{len(rows)} rows with {condition}")
        return cell(rows[0], columns)
    names = [tuple(part.split(" as ")) if " as " in part else (part, part) for part in columns.split("; ")]
    lines = [[title for _, title in names], ["---"] * len(names)]
    lines += [[cell(row, name) for name, _ in names] for row in rows]
    return "\n" + "".join("| " + " | ".join(line) + " |\n" for line in lines)


def filled(text: str) -> str:
    """The text with every mark filled."""
    return MARK.sub(lambda m: m[1] + content(m[2], m[3], m[4], m[5], m[6]) + m[8], text)


def main() -> None:
    for path in texts():
        before = path.read_text()
        after = filled(before)
        if after != before:
            path.write_text(after)
            print(f"{path.relative_to(ROOT)}: figures taken from docs/bench")


if __name__ == "__main__":
    main()
