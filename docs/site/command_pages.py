# SPDX-License-Identifier: MIT
"""The reference of commands: every command, argument and option of the programs, as their --help has them."""

import inspect
import re
from collections.abc import Iterator
from enum import Enum
from typing import Any

import typer
import typer.main
from typer.core import TyperGroup

from docs.site.markdown import table

INTRO = """\
# Commands and options

Every command of the four programs with its arguments and options, made from the programs themselves; `--help` shows
the same. [Commands](../commands.md) says more in one page. A *required* option has no default; a flag is off by
default if nothing else is said; options marked * may be repeated.

"""
SAID = re.compile(r"\[default: (.+?)\]")
HEAD = ("option", "default", "allowed", "meaning")


def programs() -> dict[str, Any]:
    """The programs by name, as commands of click."""
    from clients.__main__ import app as client
    from clients.demo.command import app as face
    from precond_worker.cli import app as worker
    from sim_server.cli import app as server

    apps = {"sim-server": server, "precond-worker": worker, "sim-client": client, "warpfactor": face}
    return {name: typer.main.get_command(app) for name, app in apps.items()}


def page() -> str:
    """The whole page in Markdown."""
    parts = [INTRO]
    for name, program in programs().items():
        about = f"{_prose(program.help)}\n\n" if isinstance(program, TyperGroup) else ""
        parts += [f"## {name}\n\n", about or _shown(name, program)]
        for words, command in commands(name, program):
            parts += [f"### {words}\n\n", _shown(words, command)]
    return "".join(parts)


def commands(words: str, group: Any) -> Iterator[tuple[str, Any]]:
    """Yields the commands of a group, also those of groups in it, with all words before their arguments."""
    for name, command in getattr(group, "commands", {}).items():
        if isinstance(command, TyperGroup):
            yield from commands(f"{words} {name}", command)
        elif not command.hidden:
            yield f"{words} {name}", command


def _shown(words: str, command: Any) -> str:
    arguments = [p for p in command.params if _is_argument(p)]
    usage = " ".join([words, "[OPTIONS]", *(_metavar(p) + ("..." if p.nargs == -1 else "") for p in arguments)])
    rows = [_row(p) for p in command.params if not p.hidden]
    examples = inspect.cleandoc((command.epilog or "").replace("\b", "")).strip()
    parts = [f"```text\n{usage}\n```", _prose(command.help), table(HEAD, rows).rstrip()]
    return "\n\n".join([*parts, *([f"```text\n{examples}\n```"] if examples else [])]) + "\n\n"


def _is_argument(parameter: Any) -> bool:
    return not parameter.opts[0].startswith("-")


def _metavar(parameter: Any) -> str:
    return parameter.metavar or parameter.name.upper()


def _prose(text: str | None) -> str:
    """Help as Markdown: lines of a paragraph joined, those of one that begins with click's mark \\b kept."""
    shown = []
    for paragraph in inspect.cleandoc(text or "").split("\n\n"):
        if paragraph.startswith("\b\n"):
            shown.append(f"```text\n{paragraph[2:]}\n```")
        else:
            shown.append(_escaped(" ".join(paragraph.split())))
    return "\n\n".join(shown)


def _escaped(text: str) -> str:
    return re.sub(r"([*<>\[\]])", r"\\\1", text)


def _row(parameter: Any) -> tuple[str, str, str, str]:
    names = ", ".join(f"`{name}`" for name in (*parameter.opts, *parameter.secondary_opts))
    if _is_argument(parameter):
        names = f"`{_metavar(parameter)}`"
    elif not parameter.is_flag:
        names += f" `{_metavar(parameter)}`"
    several = parameter.nargs == -1 or parameter.multiple
    meaning = _escaped(SAID.sub("", parameter.help or "").strip())
    return names + " *" * several, _default(parameter), _allowed(parameter), meaning


def _default(parameter: Any) -> str:
    if parameter.required:
        return "*required*"
    default = parameter.default
    if not _is_argument(parameter) and parameter.is_flag:
        return f"`{parameter.opts[0]}`" if default is True and parameter.secondary_opts else "off"
    if said := SAID.search(parameter.help or ""):
        return said[1]
    return "–" if default is None or default == () or callable(default) else f"`{getattr(default, 'value', default)}`"


def _allowed(parameter: Any) -> str:
    kind = parameter.type_descriptor.annotation
    if isinstance(kind, type) and issubclass(kind, Enum):
        return ", ".join(f"`{choice.value}`" for choice in kind)
    words = [f"at least {parameter.min:g}"] if parameter.min is not None else []
    return ", ".join([*words, *([f"at most {parameter.max:g}"] if parameter.max is not None else [])])
