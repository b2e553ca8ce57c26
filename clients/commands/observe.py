# SPDX-License-Identifier: MIT
"""Commands that show a running server as text."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from clients.options.common import Connect, Json, Server
from protocol.channels import SERVER_NAME

app = typer.Typer()


@app.command()
def status(
    as_json: Json = False,
    connect: Connect = None,
    server: Server = SERVER_NAME,
) -> None:
    """Show the server's health and where its objects are, once.

    \b
    Examples:
      sim-client status
      sim-client status --json | jq .step_p99
      sim-client status --connect tcp/192.168.1.5:7447
    """
    from clients.client import Client
    from clients.to_json import to_json

    with Client(server, connect) as client:
        found = client.status(fresh=True)
    if as_json:
        print(json.dumps(to_json(found)))
        return
    from rich.console import Console

    from clients.watch import places, tables

    Console().print(tables(found), places(found))


@app.command()
def watch(
    count: Annotated[int, typer.Option(min=0, help="End after N readings; 0 = never.")] = 0,
    connect: Connect = None,
    server: Server = SERVER_NAME,
) -> None:
    """Show the server's health until Ctrl-C.

    \b
    Examples:
      sim-client watch
    """
    from clients.client import Client
    from clients.watch import watch as run

    with Client(server, connect) as client:
        run(client, count)
