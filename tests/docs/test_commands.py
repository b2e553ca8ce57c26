# SPDX-License-Identifier: MIT
"""docs/commands.md has the options of the four programs, with their defaults and bounds, and no others."""

import importlib.util
import re
from typing import Any

import pytest
import typer.main
from typer.core import TyperGroup, TyperOption

from clients.__main__ import app as client
from clients.demo.command import app as face
from precond_worker.cli import app as worker
from sim_server.certificates.command import app as certs
from sim_server.cli import app as server
from tests.docs.figures import DOCS, ROOT, table_under, texts

TEXT = (DOCS / "commands.md").read_text()
SHARED = {"--connect", "--server", "--tls"}  # of all commands that talk to a server; said once


def _launch() -> Any:
    spec = importlib.util.spec_from_file_location("launch_of_docs", ROOT / "deploy" / "launch.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.app


def _options(command: Any) -> list[TyperOption]:
    general = {"--help", "--version", "--install-completion", "--show-completion"}
    return [p for p in command.params if isinstance(p, TyperOption) and not p.hidden and not general & set(p.opts)]


def _default(option: TyperOption) -> set[str]:
    """What the page may say of the default."""
    if said := re.search(r"\[default: (.+?)\]", option.help or ""):
        return {said[1]}
    if option.default is None:
        return {"none", "no end"}
    if option.is_flag:
        return {option.opts[0]} if option.default else {"off"}
    return {str(option.default)}


def _largest(option: TyperOption) -> float | None:
    return getattr(option, "max", None)


PROGRAMS = {
    "sim-server SCENE.toml": typer.main.get_command(server),
    "sim-server certs DIR": typer.main.get_command(certs),
    "precond-worker": typer.main.get_command(worker),
    "deploy/launch.py SCENE.toml": typer.main.get_command(_launch()),
}
GROUPS = {"sim-client COMMAND": typer.main.get_command(client), "warpfactor COMMAND": typer.main.get_command(face)}


@pytest.mark.parametrize("heading", PROGRAMS)
def test_options_of_a_program(heading: str) -> None:
    rows = {}
    for row in table_under(TEXT, heading):
        names = re.findall(r"--[a-z-]+", row["option"])
        if "--help" not in names:
            rows[tuple(names)] = row
    options = {tuple(o.opts + o.secondary_opts): o for o in _options(PROGRAMS[heading])}
    assert set(rows) == set(options)
    for names, option in options.items():
        row = rows[names]
        assert row["default"].replace("`", "") in _default(option), names
        assert ("*" in row["option"]) == option.multiple, names
        value = re.fullmatch(r"`--[a-z-]+ (.+)`( \*)?", row["option"])
        if value:
            metavar = (option.metavar or "").replace("[@EP]", "[@ENDPOINT]")
            assert value[1] == ("ENDPOINT" if metavar == "EP" else metavar), names
        elif not option.is_flag:
            pytest.fail(f"{names}: the page does not say that it takes {option.metavar}")
        if (largest := _largest(option)) is not None:
            assert f"at most {largest:g}" in row["meaning"], names


def _commands(heading: str) -> dict[str, str]:
    """Command: what its row says of its options."""
    return {
        name: row["its options (default)"]
        for row in table_under(TEXT, heading)
        for name in re.findall(r"`([a-z-]+)[^`]*`", row["command"])
    }


@pytest.mark.parametrize("heading", GROUPS)
def test_commands_of_a_program(heading: str) -> None:
    group = GROUPS[heading]
    assert isinstance(group, TyperGroup)
    said = _commands(heading)
    assert set(said) == set(group.commands)
    for name, command in group.commands.items():
        own = {o.opts[0]: o for o in _options(command)}
        if name != "replay":  # it has a --connect of its own
            own = {k: o for k, o in own.items() if k not in SHARED}
        cell = said[name].split(" No `--server`")[0]
        assert set(re.findall(r"`(--[a-z-]+)", cell)) == set(own), name
        for option in own.values():
            if option.required or option.default in (None, False):
                continue
            default = getattr(option.default, "value", option.default)
            shown = f"{default:g}" if isinstance(default, float) else str(default)
            said_so = re.search(rf"`{option.opts[0]}[^`]*`(?:, `--to`)?[^;,(]*\(`?{re.escape(shown)}`?\)", cell)
            assert said_so or (option.opts[0] == "--from" and default == 0), (name, option.opts[0], shown)


def _examples() -> list[tuple[str, str]]:
    """(document, command line) of all code blocks, without comments; of lines joined by && each."""
    lines = []
    for path in texts():
        for block in re.findall(r"^```(?:sh)?\n(.*?)^```", path.read_text(), re.MULTILINE | re.DOTALL):
            said = [line.split(" #")[0] for line in block.splitlines()]
            lines += [(path.name, part.strip()) for line in said for part in line.split(" && ")]
    return [(name, line) for name, line in lines if line.startswith(("sim-server ", "sim-client ", "precond-worker "))]


def test_examples_use_options_that_are_there() -> None:
    group = typer.main.get_command(client)
    assert isinstance(group, TyperGroup)
    commands = {"sim-server": PROGRAMS["sim-server SCENE.toml"], "precond-worker": PROGRAMS["precond-worker"]}
    commands["sim-server certs"] = PROGRAMS["sim-server certs DIR"]
    commands |= {f"sim-client {name}": command for name, command in group.commands.items()}
    examples = _examples()
    assert len(examples) > 15
    for name, line in examples:
        words = line.split()
        program = " ".join(words[:2]) if words[0] == "sim-client" or words[1] == "certs" else words[0]
        known = {name for p in commands[program].params for name in (*p.opts, *p.secondary_opts)}
        assert {word for word in words if word.startswith("--")} <= known, (name, line)
