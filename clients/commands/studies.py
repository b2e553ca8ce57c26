# SPDX-License-Identifier: MIT
"""Commands that run scenes on servers of their own, and measure."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from clients.options.common import Elsewhere, Json, Server
from protocol.channels import SERVER_NAME

app = typer.Typer()


@app.command()
def load(
    objects: Annotated[int, typer.Option(metavar="K", help="Bodies of the scene.")] = 16,
    tets: Annotated[str, typer.Option(metavar="A..B", help="Tetrahedra of a body, equally likely on every scale.")] = (
        "200..3000"
    ),
    clients: Annotated[int, typer.Option(metavar="N", help="Clients; every second one grabs, the others push.")] = 8,
    rate: Annotated[float, typer.Option(metavar="HZ", help="Commands a second of each client.")] = 50.0,
    seconds: Annotated[float, typer.Option(metavar="S", help="For how long.")] = 20.0,
    quiet: Annotated[float, typer.Option(metavar="S", help="Watched before without clients, to compare with.")] = 3.0,
    workers: Annotated[int, typer.Option(metavar="N", help="Local workers of the server.")] = 1,
    seed: Annotated[int, typer.Option(metavar="N", help="Of sizes, materials and disturbances.")] = 1,
    device: Annotated[str, typer.Option(metavar="auto|cpu|gpu", help="Of the server.")] = "cpu",
    out: Annotated[Path | None, typer.Option(metavar="FOLDER", help="Keep scene, log, load.json and load.png.")] = None,
    as_json: Json = False,
    connect: Elsewhere = None,
    server: Server = SERVER_NAME,
) -> None:
    """Load a server with bodies and clients, and report its steps, workers and commands.

    Starts a server with a scene drawn from the seed. With --connect it loads a running one, whose objects, tets,
    workers and device it takes as they are.

    \b
    Examples:
      sim-client load --objects 16 --tets 200..3000 --clients 8 --rate 50 --seconds 20 --workers 2
      sim-client load --objects 4 --clients 50 --rate 1000 --out out/load
      sim-client load --connect tcp/127.0.0.1:7447 --clients 20 --rate 200 --seconds 10 --json
    """
    from clients.load_test.options import LoadOptions, span
    from clients.load_test.run import run

    options = LoadOptions(
        objects,
        span(tets),
        clients,
        rate,
        seconds,
        workers,
        seed,
        device,
        out,
        connect,
        server,
        quiet,
    )
    found = run(options)
    if out is not None:
        from clients.load_test.plots import draw

        (out / "load.json").write_text(json.dumps(found, indent=1) + "\n")
        (out / "load.png").write_bytes(draw(found))
    if as_json:
        print(json.dumps(found))
        return
    from rich.console import Console

    from clients.load_test.report import tables

    Console().print(tables(found))


@app.command()
def accuracy(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="What to measure.")],
    minutes: Annotated[float, typer.Option(metavar="M", help="Time to spend; 0: only draw what is there.")] = 5.0,
    duration: Annotated[float, typer.Option(metavar="S", help="Simulated in each run.")] = 1.0,
    out: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="For the results; by default accuracy-SCENE.")
    ] = None,
    device: Annotated[str, typer.Option(metavar="auto|cpu|gpu", help="Of the servers.")] = "auto",
    as_json: Json = False,
) -> None:
    """Measure what accuracy costs in a scene: runs it at many settings and compares them with a reference.

    Starts a server for each run. Points are kept as they come: after the time given or Ctrl-C the same command goes
    on. Writes points.json, points.csv, accuracy.png and accuracy.html.

    \b
    Examples:
      sim-client accuracy deploy/scenes/beam.toml
      sim-client accuracy beam.toml --minutes 20 --duration 2 --out out/beam
      sim-client accuracy beam.toml --json | jq .sentence
    """
    from clients.accuracy import command

    command.accuracy(scene, out, minutes, duration, device, as_json)


@app.command()
def plan(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="What is to be simulated.")],
    budget_ms: Annotated[
        float | None, typer.Option("--budget-ms", metavar="MS", help="Wall time that a step (p99) may take.")
    ] = None,
    position: Annotated[float | None, typer.Option(metavar="M", help="Error that a node may have, m.")] = None,
    points: Annotated[
        Path | None, typer.Option(metavar="FILE", help="points.json or its folder; by default accuracy-SCENE.")
    ] = None,
    measure: Annotated[
        float, typer.Option(metavar="MINUTES", help="Time for measurements first: what may be better.")
    ] = 0.0,
    to: Annotated[Path | None, typer.Option(metavar="FILE.toml", help="Overlay; SCENE.plan.toml.")] = None,
    as_json: Json = False,
) -> None:
    """Propose settings of a scene from what was measured, and write them for sim-server --set @FILE.

    With --budget-ms the most exact settings that are fast enough in real time, with --position the cheapest ones that
    are exact enough; measured ones alone (sim-client accuracy), nothing between them. Exit code 1: there are none.

    --measure makes those measurements if there are none, and tries settings together that were measured apart.

    \b
    Examples:
      sim-client plan beam.toml --budget-ms 2        and then: sim-server beam.toml --set @beam.plan.toml
      sim-client plan beam.toml --position 1e-3 --to exact.toml
    """
    from clients.plan.front import wish_for
    from clients.plan.run import plan as run

    reached = run(scene, wish_for(budget_ms, position), points, to, measure, as_json)
    raise typer.Exit(0 if reached else 1)


@app.command()
def identify(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="What was measured, with its loads.")],
    curves: Annotated[Path, typer.Argument(metavar="CURVES.csv", help="time and measured columns.")],
    fit: Annotated[list[str], typer.Option("--fit", metavar="KEY=LOW:HIGH", help="What to find; repeatable.")],
    runs: Annotated[int, typer.Option(metavar="N", help="At most, in all.")] = 60,
    seed: Annotated[int, typer.Option(min=0, max=2**31, help="Of random tries.")] = 0,
    to: Annotated[Path | None, typer.Option(metavar="FILE.toml", help="Overlay; SCENE.identified.toml.")] = None,
    journal: Annotated[Path | None, typer.Option(metavar="FILE", help="Of runs; identify-SCENE.journal.")] = None,
    device: Annotated[str, typer.Option(metavar="auto|cpu|gpu", help="Of the servers.")] = "auto",
    as_json: Json = False,
) -> None:
    """Find parameters with which a scene moves as was measured, and write them for sim-server --set @FILE.

    Starts a server for each run. CURVES.csv has the columns time [s], OBJECT[NODE].y (displacement of a node, by
    number or by its place at rest X Y Z [m]) and OBJECT/NAME.fy (force on a holder or obstacle [N]). Runs are kept as
    they come: after Ctrl-C, or with more --runs, the same command goes on.

    \b
    Examples:
      sim-client identify beam.toml tip.csv --fit object.beam.effects.corotational.young=1e4:1e7
      sim-client identify beam.toml tip.csv --fit ...young=1e4:1e7 --fit object.beam.effects.rayleigh.mass=0:5
    """
    from clients.identify.run import identify as run

    run(scene, curves, fit, runs, seed, to, journal, device, as_json)
