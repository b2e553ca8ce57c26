# SPDX-License-Identifier: MIT
"""Commands that read logs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from clients.commands.opened_log import opened_log
from clients.errors import BadInput
from clients.options.common import Elsewhere, Json
from protocol.channels import DEFAULT_ENDPOINT

app = typer.Typer()


@app.command()
def export(
    log: Annotated[Path, typer.Argument(metavar="LOG.mcap", help="A recorded run.")],
    to: Annotated[Path, typer.Option(metavar="FILE", help="FILE.npz, .csv, .vtu, .vtkhdf, .usdc, .mp4 or .mcap.")],
    object: Annotated[str | None, typer.Option(metavar="NAME", help="By default all objects.")] = None,
    frame: Annotated[str, typer.Option(help="Of a .vtu: last, a number (0 first, -1 last), or all.")] = "last",
    epoch: Annotated[int | None, typer.Option(help="Of an .npz: which mesh, if cuts changed it.")] = None,
) -> None:
    """Write a log for other programs.

    .npz (NumPy), .csv (scalars), .vtu and .vtkhdf (ParaView), .usdc (Blender), .mp4 (film), .mcap (Foxglove).

    \b
    Examples:
      sim-client export run.mcap --to run.vtkhdf
      sim-client export run.mcap --to run.usdc
      sim-client export run.mcap --to run.foxglove.mcap
      sim-client export run.mcap --object beam --to beam.npz
      sim-client export run.mcap --object beam --to beam.vtu --frame all
    """
    from clients.export.export import export as write
    from clients.progress import progress_bar

    with opened_log(log) as opened:
        chosen = list(opened.objects.values()) if object is None else [opened.object_log(object)]
        with progress_bar("writing", sum(len(each.frames) for each in chosen)) as progress:
            written = write(opened, object, to, frame, epoch, progress)
        print(f"wrote {written[-1]}" + (f" and {len(written) - 1} more" if len(written) > 1 else ""))


@app.command()
def replay(
    log: Annotated[Path, typer.Argument(metavar="LOG.mcap", help="A recorded run.")],
    simulate: Annotated[bool, typer.Option("--simulate", help="Run it again and compare bit by bit.")] = False,
    speed: Annotated[str, typer.Option(metavar="N|max", help="Simulated seconds a second.")] = "1",
    loop: Annotated[bool, typer.Option("--loop", help="From the beginning again at the end.")] = False,
    begin: Annotated[float, typer.Option("--from", metavar="SECONDS", help="Where to begin, s of simulation.")] = 0.0,
    end: Annotated[float | None, typer.Option("--to", metavar="SECONDS", help="Where to end.")] = None,
    name: Annotated[
        str | None, typer.Option(metavar="NAME", help="Name of the server that it plays; else the log's, if free.")
    ] = None,
    connect: Elsewhere = None,
    listen: Annotated[
        list[str] | None, typer.Option(metavar="ENDPOINT", help=f"Where to be reached, {DEFAULT_ENDPOINT} by default.")
    ] = None,
    tls: Annotated[
        str | None,
        typer.Option("--tls", metavar="DIR", help="Folder of the certificate of a server, beside the others."),
    ] = None,
    insecure: Annotated[bool, typer.Option("--insecure", help="Let everybody in, also from other machines.")] = False,
    as_json: Json = False,
) -> None:
    """Send a log out as if its server were live; or run it again and compare.

    With --simulate: exit code 0 the same bit for bit, 1 diverged, 2 no log that can be run again.

    \b
    Examples:
      sim-client replay run.mcap --loop          and elsewhere: sim-client view --live
      sim-client replay run.mcap --speed 0.5 --from 2 --to 4
      sim-client replay run.mcap --name old --connect tcp/127.0.0.1:7447
      sim-client replay run.mcap --tls certs --listen tls/0.0.0.0:7447
      sim-client replay run.mcap --simulate
    """
    from clients.replay import command as replay_command

    if not simulate:
        replay_command.republish(log, speed, loop, begin, end, name, connect, listen, as_json, insecure, tls)
        return
    if speed != "1" or loop or begin or end is not None or name or connect or listen or tls or insecure:
        raise BadInput("replay: --simulate takes no other options than --json")
    raise typer.Exit(replay_command.simulate(log, as_json))
