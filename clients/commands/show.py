# SPDX-License-Identifier: MIT
"""Commands that show bodies: in a viewer, a browser, Foxglove."""

from __future__ import annotations

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from clients.commands.opened_log import opened_log
from clients.errors import BadInput
from clients.options.common import Connect, Server
from protocol.channels import SERVER_NAME
from protocol.network.web_address import HOST, PORT

app = typer.Typer()


class Color(StrEnum):
    displacement = "displacement"
    von_mises = "von_mises"


@app.command()
def view(
    log: Annotated[Path | None, typer.Argument(metavar="[LOG.mcap]", help="A recorded run.")] = None,
    live: Annotated[bool, typer.Option("--live", help="Show a running server instead.")] = False,
    save: Annotated[Path | None, typer.Option(metavar="FILE.rrd", help="Write a file for rerun instead.")] = None,
    screenshot: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Or .jpg: write a picture.")] = None,
    color: Annotated[Color, typer.Option(help="What the surfaces are coloured by.")] = Color.displacement,
    web: Annotated[bool, typer.Option("--web", help="A page for a browser of this machine, no window.")] = False,
    connect: Connect = None,
    server: Server = SERVER_NAME,
) -> None:
    """Show a log or a running server in the rerun viewer.

    \b
    Examples:
      sim-client view run.mcap
      sim-client view run.mcap --color von_mises --screenshot run.png
      sim-client view run.mcap --save run.rrd
      sim-client view --live
    """
    if live == (log is not None):
        raise BadInput("view: give either a log or --live")
    from clients.viewer import view as viewing

    if live:
        if save or screenshot:
            raise BadInput("view: --save and --screenshot need a log, not --live")
        from clients.client import Client

        with Client(server, connect) as client:
            viewing.view_live(client, color.value, web)
        return
    assert log is not None
    with opened_log(log) as opened:
        if save:
            viewing.save_rrd(opened, save, color.value)
        if screenshot:
            viewing.save_screenshot(opened, screenshot, color.value)
        if not save and not screenshot:
            viewing.view_log(opened, color.value, web)


@app.command()
def web(
    host: Annotated[
        str, typer.Option(metavar="HOST", help="Where the page is served; who reaches it may do what this client may.")
    ] = HOST,
    port: Annotated[int, typer.Option(metavar="PORT", min=1, max=65535, help="Of the page.")] = PORT,
    exit_with_parent: Annotated[
        bool, typer.Option("--exit-with-parent", help="End when the parent process ends.")
    ] = False,
    parent: Annotated[int | None, typer.Option("--parent", hidden=True, help="Its process id.")] = None,
    connect: Connect = None,
    server: Server = SERVER_NAME,
) -> None:
    """Serve a page where bodies are dragged with the mouse, changed and watched, until Ctrl-C.

    \b
    Examples:
      sim-client web
      sim-client web --port 8090
      sim-client web --connect tcp/192.168.1.5:7447
    """
    from clients.web import command

    command.web(server, connect, host, port, exit_with_parent, parent)


@app.command()
def foxglove(
    host: Annotated[str, typer.Option(metavar="HOST", help="Where it listens; who reaches it sees the run.")] = HOST,
    port: Annotated[int, typer.Option(metavar="PORT", min=1, max=65535, help="Of the WebSocket server.")] = 8765,
    layout: Annotated[Path | None, typer.Option(metavar="FILE.json", help="Also write a layout to import.")] = None,
    connect: Connect = None,
    server: Server = SERVER_NAME,
) -> None:
    """Show a running server in Foxglove or Lichtblick, until Ctrl-C: open ws://127.0.0.1:8765 there.

    \b
    Examples:
      sim-client foxglove
      sim-client foxglove --layout beam.layout.json
      sim-client foxglove --port 8766 --connect tcp/192.168.1.5:7447
    """
    from clients.client import Client
    from clients.export import foxglove_live
    from protocol.network.hosts import beyond_loopback
    from protocol.network.web_address import shown

    with Client(server, connect) as client:
        if layout is not None:
            foxglove_live.write_layout(client, layout)
        if beyond_loopback(f"tcp/{shown(host, port)}"):
            print(f"sim-client: {shown(host, port)} is open to the network, without a login", file=sys.stderr)

        def say(port: int) -> None:
            print(f"sim-client: open ws://{shown(host, port)} in Foxglove or Lichtblick", flush=True)

        foxglove_live.serve(client, host, port, say)
