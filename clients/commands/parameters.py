# SPDX-License-Identifier: MIT
"""Commands for parameters of a running scene, and for the materials that scenes may name."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Annotated

import typer

from clients.errors import BadInput
from clients.options.common import Connect, Json, Server
from protocol.channels import SERVER_NAME

if TYPE_CHECKING:
    from protocol import messages_pb2 as pb

app = typer.Typer()


@app.command("set")
def set_parameters(
    values: Annotated[list[str], typer.Argument(metavar="KEY=VALUE...", help="As after --set of sim-server.")],
    as_json: Json = False,
    connect: Connect = None,
    server: Server = SERVER_NAME,
) -> None:
    """Change parameters of the scene while it runs, all between the same two steps.

    KEY is OBJECT.EFFECT.KEY, EFFECT.KEY of the whole scene, NAME.KEY of an object or obstacle, or a key as after --set.
    `sim-client parameters` lists them.

    \b
    Examples:
      sim-client set beam.corotational.young=2e5
      sim-client set gravity.g='[0, -1.6, 0]' beam.rayleigh.mass=0.5
    """
    from clients.client import Client

    given: dict[str, str] = {}
    for each in values:
        key, equals, value = each.partition("=")
        if not equals or not key.strip() or key.strip() in given:
            raise BadInput(f"set: {each!r}: must be KEY=VALUE, each KEY once")
        given[key.strip()] = value.strip()
    with Client(server, connect) as client:
        _show_parameters(client.set(given), as_json)


@app.command()
def parameters(as_json: Json = False, connect: Connect = None, server: Server = SERVER_NAME) -> None:
    """List the parameters of the scene that may change while it runs.

    \b
    Examples:
      sim-client parameters
      sim-client parameters --json | jq '.[].now.key'
    """
    from clients.client import Client

    with Client(server, connect) as client:
        _show_parameters(client.parameters(), as_json)


def _show_parameters(found: list[pb.LiveParameter], as_json: bool) -> None:
    if as_json:
        from clients.to_json import to_json

        print(json.dumps([to_json(each) for each in found]))
        return
    from rich.console import Console

    from clients.watch import parameter_table

    Console().print(parameter_table(found))


@app.command()
def materials(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Only this one, with its sources.")] = None,
    as_json: Json = False,
) -> None:
    """List the materials that an object of a scene may name, or show one: law, constants, range, sources.

    \b
    Examples:
      sim-client materials
      sim-client materials liver
      sim-client materials ecoflex_00_30 --json | jq .typical
    """
    from clients.materials.show import show

    show(name, as_json)
