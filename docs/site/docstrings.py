# SPDX-License-Identifier: MIT
"""Turns the plain English of our docstrings into reStructuredText for Sphinx."""

import re
from typing import Any

SPECIAL = re.compile(r"(?<!\\)([*|\\]|(?<=\w)_(?=\W|$))")
EXAMPLE = (">>>", "... ")
ARGUMENT = re.compile(r"[a-z_, ]+(\[.*\])?: ")


def as_rest(app: Any, what: str, name: str, obj: object, options: object, lines: list[str]) -> None:
    """Handler of autodoc-process-docstring: changes the lines in place."""
    lines[:] = converted(lines)


def converted(lines: list[str]) -> list[str]:
    """The lines with what reStructuredText would take for marks escaped, and `code` as ``code``.

    Examples (>>> ...) and blocks after "::" stay as they are; a blank line goes before and after an example. A line
    "name: ..." begins a paragraph of its own.
    """
    made: list[str] = []
    literal = False
    for line in lines:
        example = line.lstrip().startswith(EXAMPLE)
        if literal and line and not line.startswith(" "):
            literal = False
        if example or literal:
            if example and made and made[-1] and not made[-1].lstrip().startswith(EXAMPLE):
                made.append("")
            made.append(line)
            continue
        if line.endswith("::"):
            literal = True
        if (
            made
            and made[-1].strip()
            and (made[-1].lstrip().startswith(">>>") or re.match(r"[a-z_, ]+(\[.*\])?: ", line))
        ):
            made.append("")
        made.append(_text(line))
    return made


def _text(line: str) -> str:
    """One line of prose or of a list."""
    mark = re.match(r"\s*([*-] )?", line)
    assert mark is not None
    parts = re.split(r"(`+[^`]+`+)", line[mark.end() :])
    return mark[0] + "".join(f"``{p.strip('`')}``" if p.startswith("`") else SPECIAL.sub(r"\\\1", p) for p in parts)
