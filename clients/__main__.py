# SPDX-License-Identifier: MIT
# ruff: noqa: E402 (signal handlers are set before anything else is imported)
"""The command sim-client."""

from __future__ import annotations

from protocol.process.early_signals import end_at_once

end_at_once(terminated=143)  # until main() sets its own handlers

import contextlib
import json
import signal
import sys
import time
from collections.abc import Iterator
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from clients.errors import BadInput, ClientError
from clients.options.point import AT_HELP, PointCommand, point
from clients.options.tls import TlsGroup
from protocol.channels import DEFAULT_ENDPOINT, SERVER_NAME
from protocol.log_pieces import size_of_log
from protocol.network.endpoints import CONNECT
from protocol.network.web_address import HOST, PORT
from protocol.printable import printable
from protocol.process.command_line import Program, handle, leave
from protocol.process.exhausted import exhausted
from protocol.process.extras import missing_extra
from protocol.push_limits import ORPHANED_PUSH

if TYPE_CHECKING:
    from clients.client import Client
    from protocol import messages_pb2 as pb

PROGRAM = Program("sim-client")
app = typer.Typer(
    name="sim-client",
    cls=TlsGroup,
    help="Look at a running sim-server, push its bodies about, view and export its logs.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

Triple = tuple[float, float, float]
Connect = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ENDPOINT",
        help=f"Where the server listens; may be repeated. By default {CONNECT} (separated by commas or spaces) "
        f"or {DEFAULT_ENDPOINT}.",
    ),
]
Elsewhere = Annotated[
    list[str] | None, typer.Option(metavar="ENDPOINT", help="Of a server or router that runs; may be repeated.")
]
Server = Annotated[str, typer.Option(metavar="NAME", help="Name of the server.")]
Object = Annotated[str, typer.Option("--object", metavar="NAME", help="Object of the scene.")]
At = Annotated[str, typer.Option("--at", metavar="POINT", help=AT_HELP)]
Json = Annotated[bool, typer.Option("--json", help="For programs.")]
MOVES_PER_SECOND = 30


class Change(StrEnum):
    add = "add"
    kill = "kill"


class Color(StrEnum):
    displacement = "displacement"
    von_mises = "von_mises"


@app.callback()
def client(
    version: Annotated[bool, PROGRAM.version_option()] = False,
) -> None:
    """Look at a running sim-server, push its bodies about, view and export its logs."""


@app.command()
def status(
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
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


@app.command(cls=PointCommand)
def push(
    object: Object,
    force: Annotated[Triple, typer.Option(metavar="FX FY FZ", help="Force in all, N.")],
    at: At = "tip",
    radius: Annotated[float, typer.Option(help="Nodes this near are pushed, m; 0 = the nearest free one.")] = 0.0,
    duration: Annotated[float, typer.Option(help="For how long, s of simulation.")] = 0.1,
    connect: Connect = None,
    server: Server = SERVER_NAME,
) -> None:
    """Push an object.

    A push of more than 10 s keeps the command until it is over: without its client it would end after 10 s.

    \b
    Examples:
      sim-client push --object beam --force 5000 0 0
      sim-client push --object beam --at top --radius 0.6 --force 0 0 500 --duration 0.5
      sim-client push --object beam --at 10 1 1 --force 0 -200 0
    """
    from clients.client import Client

    begin = point(at)
    with Client(server, connect) as client:
        taken = client.push(object, begin, force, radius, duration)
        what = f"{_nodes(taken.nodes)} of {object} at {_coordinates(taken.point)} for {duration:g} s"
        if duration <= ORPHANED_PUSH:
            print(f"pushed {what}")
            return
        print(f"pushing {what}; Ctrl-C ends it", flush=True)
        _await_end(client, taken)
    print("done")


@app.command(cls=PointCommand)
def grab(
    object: Object,
    to: Annotated[Triple, typer.Option(metavar="X Y Z", help="Where to pull it on a straight line, m.")],
    at: At = "tip",
    radius: Annotated[float, typer.Option(help="Nodes this near are held, m; 0 = the nearest free one.")] = 0.0,
    stiffness: Annotated[float, typer.Option(help="Of the spring that pulls, N/m.")] = 1000.0,
    max_force: Annotated[float, typer.Option(help="That the spring never exceeds, N.")] = 100.0,
    duration: Annotated[float, typer.Option(help="How long the pull takes, s of wall clock.")] = 1.0,
    connect: Connect = None,
    server: Server = SERVER_NAME,
) -> None:
    """Take hold of an object, pull it along a straight line, let go (also on Ctrl-C).

    \b
    Examples:
      sim-client grab --object beam --to 10 4 1 --duration 2
      sim-client grab --object beam --at 10 1 1 --to 12 1 1 --stiffness 5000 --max-force 500
    """
    from clients.client import Client, number

    number(duration, "duration", positive=True)
    begin = point(at)
    with Client(server, connect) as client, client.grab(object, begin, None, radius, stiffness, max_force) as held:
        found = held.interaction
        print(f"holding {_nodes(found.nodes)} of {object} at {_coordinates(found.point)}", flush=True)
        start = (found.point.x, found.point.y, found.point.z)
        began = time.monotonic()
        while (share := (time.monotonic() - began) / duration) < 1:
            held.move([a + share * (b - a) for a, b in zip(start, to, strict=True)])
            time.sleep(1 / MOVES_PER_SECOND)
        held.move(to)
    print("released")


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


@app.command("move-obstacle")
def move_obstacle(
    name: Annotated[str, typer.Argument(metavar="NAME", help='Obstacle or holder with moved = "client".')],
    to: Annotated[Triple, typer.Option(metavar="X Y Z", help="Where its own origin goes, m.")],
    rotate: Annotated[
        Triple | None,
        typer.Option(metavar="A B C", help="Degrees about the fixed axes x, then y, then z; else it is not turned."),
    ] = None,
    connect: Connect = None,
    server: Server = SERVER_NAME,
) -> None:
    """Move an obstacle or a holder; it goes there at the speeds that the scene allows, and stays.

    \b
    Examples:
      sim-client move-obstacle tool --to 0 0.2 0
      sim-client move-obstacle tool --to 0 0.2 0 --rotate 0 0 90
    """
    from clients.client import Client
    from clients.obstacle import turned

    with Client(server, connect) as client:
        client.obstacle(name).move(to, None if rotate is None else turned(rotate), wait=True)
    print(f"{name} goes to ({', '.join(f'{value:.4g}' for value in to)})")


@app.command()
def cut(
    object: Object,
    blade: Annotated[
        str | None,
        typer.Option(metavar="CORNERS", help='3 or 4 of the surface that a blade sweeps, "X Y Z, X Y Z, ...", m.'),
    ] = None,
    sphere: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(metavar="X Y Z R", help="Takes the elements with centroids in it, m."),
    ] = None,
    where: Annotated[str | None, typer.Option(metavar="EXPRESSION", help="In X, Y, Z of centroids at rest.")] = None,
    elements: Annotated[str | None, typer.Option(metavar="NUMBERS", help='Of the mesh, from 0, as "3 7-9 12".')] = None,
    split: Annotated[
        bool, typer.Option("--split", help="Removes none: opens faces along the blade, or around the elements.")
    ] = False,
    as_json: Json = False,
    connect: Connect = None,
    server: Server = SERVER_NAME,
) -> None:
    """Remove elements of an object that lists the effect cutting: what a blade meets, a sphere, a region, by number.

    A blade and a sphere are where the object is now. `sim-client reset` puts all back. With --split the object is split
    along faces of its elements and loses nothing; it must list cutting = { spare = N }.

    \b
    Examples:
      sim-client cut --object liver --blade "0 0 0, 0.1 0 0, 0.1 0.1 0, 0 0.1 0"
      sim-client cut --object liver --split --blade "0 0 0, 0.1 0 0, 0.1 0.1 0, 0 0.1 0"
      sim-client cut --object beam --sphere 0.5 0.5 4 0.3
      sim-client cut --object beam --where "abs(Z - 2) < 0.1 and Y > 0.5"
    """
    from clients.client import Client

    center, radius = (sphere[:3], sphere[3]) if sphere else (None, 0.0)
    with Client(server, connect) as client:
        reply = client.cut(
            object,
            blade=_corners(blade or ""),
            center=center,
            radius=radius,
            where=where or "",
            elements=elements or "",
            split=split,
        )
    if split:
        print(
            json.dumps({"opened": reply.opened, "copied": reply.copied}) if as_json
            else f"{reply.opened} faces opened, {reply.copied} nodes copied"
        )  # fmt: skip
    elif as_json:
        print(json.dumps({"removed": reply.removed, "left": reply.left}))
    else:
        print(f"{reply.removed} elements removed, {reply.left} left")


def _corners(text: str) -> list[Triple]:
    """Returns the points of a text such as "0 0 0, 1 0 0, 1 1 0"."""
    corners = [corner.split() for corner in text.split(",")] if text else []
    try:
        return [(float(x), float(y), float(z)) for x, y, z in corners]
    except ValueError:
        raise BadInput(f'--blade {text!r}: must be 3 or 4 points, as "0 0 0, 1 0 0, 1 1 0"') from None


@app.command()
def haptics(
    name: Annotated[str, typer.Argument(metavar="NAME", help='Obstacle of the scene with moved = "client".')],
    press: Annotated[Triple, typer.Option(metavar="X Y Z", help="How far the hand goes from where it is, m.")],
    rate: Annotated[float, typer.Option(metavar="HZ", help="How often it goes there and back.")] = 0.5,
    stiffness: Annotated[float, typer.Option(help="Of the coupling between hand and obstacle, N/m.")] = 500.0,
    delay: Annotated[float, typer.Option(metavar="S", help="Expected of forces; 0: three time steps.")] = 0.0,
    seconds: Annotated[float, typer.Option(metavar="S", help="For how long.")] = 10.0,
    as_json: Json = False,
    connect: Connect = None,
    server: Server = SERVER_NAME,
) -> None:
    """Move an obstacle at 1 kHz with a scripted hand that feels it, and report how late the forces are.

    An example for a haptic device (clients/haptics), which takes the hand's place.

    \b
    Examples:
      sim-client haptics tool --press 0 -0.025 0
      sim-client haptics tool --press 0 -0.025 0 --rate 1 --stiffness 1000 --seconds 30 --json
    """
    from clients.client import Client, number
    from clients.haptics.run import run, tables

    for what, value in (("rate", rate), ("stiffness", stiffness), ("seconds", seconds)):
        number(value, what, positive=True)
    with Client(server, connect) as client:
        found = run(client, name, press, rate, stiffness, number(delay, "delay"), seconds)
    if as_json:
        print(json.dumps(found))
        return
    from rich.console import Console

    Console().print(tables(found))


def _await_end(client: Client, push: pb.Interaction) -> None:
    """Waits until a push is over; releases it on Ctrl-C."""
    from protocol import messages_pb2 as pb

    try:
        end = client.status(fresh=True).time + push.duration
        while client.status().time < end:
            time.sleep(0.2)
    except KeyboardInterrupt:
        client.command("release", pb.Interaction(id=push.id, object=push.object))
        raise


def _command(verb: str, connect: Connect, server: str, as_json: bool) -> None:
    """Sends a command that is only a verb, and prints the outcome."""
    from clients.client import Client

    with Client(server, connect) as client:
        reply = client.pause() if verb == "pause" else client.command(verb)
    _print_outcome(verb, reply, as_json)


def _print_outcome(verb: str, reply: pb.Reply, as_json: bool) -> None:
    """Prints in which state and at which step a command left the server."""
    found = reply.status
    if as_json:
        what = {"state": found.state, "step": found.step, "time": found.time, "changed": not reply.unchanged}
        print(json.dumps(what))
        return
    said = {
        "pause": "paused at",
        "resume": "goes on from",
        "stop": "stopped after",
        "step": "paused at",
        "reset": "put back at",
        "save": "saved at",
    }[verb]
    if verb in ("pause", "step") and found.state != "paused":
        said = f"{found.state} at"
    elif reply.unchanged:
        said = {"pause": "already paused, at", "resume": "already running, at"}[verb]
    steps = f"{found.step} step{'s' * (found.step != 1)}" if verb == "stop" else f"step {found.step}"
    print(f"{said} {steps} (t = {found.time:.3f} s)")


@app.command()
def pause(as_json: Json = False, connect: Connect = None, server: Server = SERVER_NAME) -> None:
    """Halt the simulation; the server goes on answering.

    \b
    Examples:
      sim-client pause
    """
    _command("pause", connect, server, as_json)


@app.command()
def step(
    steps: Annotated[int, typer.Argument(metavar="[N]", min=1, help="How many.")] = 1,
    as_json: Json = False,
    connect: Connect = None,
    server: Server = SERVER_NAME,
) -> None:
    """Have a paused server make a step, or N; it stays paused.

    \b
    Examples:
      sim-client step
      sim-client step 100
    """
    from clients.client import Client

    with Client(server, connect) as client:
        reply = client.step(steps)
    _print_outcome("step", reply, as_json)


@app.command()
def reset(
    object: Annotated[str | None, typer.Option("--object", metavar="NAME", help="Only this object.")] = None,
    as_json: Json = False,
    connect: Connect = None,
    server: Server = SERVER_NAME,
) -> None:
    """Put all objects, or one, back to the start; steps and time go on.

    \b
    Examples:
      sim-client reset
      sim-client reset --object beam
    """
    from clients.client import Client

    with Client(server, connect) as client:
        reply = client.reset(object)
    _print_outcome("reset", reply, as_json)


@app.command()
def save(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Where to write it (replaces the file).")],
    as_json: Json = False,
    connect: Connect = None,
    server: Server = SERVER_NAME,
) -> None:
    """Save the state, with which sim-server SCENE --resume FILE goes on.

    \b
    Examples:
      sim-client save beam.npz
    """
    from clients.client import Client

    with Client(server, connect) as client:
        reply = client.save(file)
    _print_outcome("save", reply, as_json)


@app.command()
def resume(as_json: Json = False, connect: Connect = None, server: Server = SERVER_NAME) -> None:
    """Go on after a pause.

    \b
    Examples:
      sim-client resume
    """
    _command("resume", connect, server, as_json)


@app.command()
def stop(as_json: Json = False, connect: Connect = None, server: Server = SERVER_NAME) -> None:
    """End the server; it closes its log first.

    \b
    Examples:
      sim-client stop
    """
    _command("stop", connect, server, as_json)


@app.command()
def worker(
    change: Annotated[Change, typer.Argument(metavar="add|kill", help="What to do.")],
    name: Annotated[str, typer.Argument(metavar="[NAME]", help="Of the local worker to kill.")] = "",
    connect: Connect = None,
    server: Server = SERVER_NAME,
) -> None:
    """Add or kill a local worker of a server with --workers; it starts a killed one again, as after any death.

    \b
    Examples:
      sim-client worker add
      sim-client worker kill local-1
    """
    from clients.client import Client

    if (change is Change.kill) != bool(name):
        raise BadInput("worker: give the NAME of a worker to kill, and none to add one")
    with Client(server, connect) as client:
        if change is Change.kill:
            client.kill_worker(name)
            print(f"killed {name}")
        else:
            print(f"started {client.add_worker()}")


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
    with _opened(log) as opened:
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

    with _opened(log) as opened:
        chosen = list(opened.objects.values()) if object is None else [opened.object_log(object)]
        with progress_bar("writing", sum(len(each.frames) for each in chosen)) as progress:
            written = write(opened, object, to, frame, epoch, progress)
        print(f"wrote {written[-1]}" + (f" and {len(written) - 1} more" if len(written) > 1 else ""))


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
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
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
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
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
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
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


def _nodes(count: int) -> str:
    return f"{count} node{'s' if count != 1 else ''}"


def _coordinates(point: pb.Vector) -> str:
    return f"({point.x:.4g}, {point.y:.4g}, {point.z:.4g})"


@contextlib.contextmanager
def _opened(path: Path) -> Iterator:
    """Opens a log and prints its gaps on stderr."""
    from clients.log.reader import Log
    from clients.progress import progress_bar

    size = size_of_log(path)
    with progress_bar("reading", size) as progress:
        log = Log(path, progress)
    with log:
        for note in log.notes:
            print(f"sim-client: {printable(note)}", file=sys.stderr)
        yield log


def main() -> None:
    """Exit codes: 0 done, 2 bad input, 1 anything else, 130 on Ctrl-C."""
    interrupted = False

    def interrupt(*_: object) -> None:
        nonlocal interrupted
        interrupted = True
        raise KeyboardInterrupt

    handle(signal.SIGINT, interrupt)
    handle(signal.SIGTERM, lambda *_: sys.exit(143))  # so that viewers and sessions are closed
    try:
        app(prog_name="sim-client")
    except BadInput as error:
        print(f"sim-client: {printable(str(error))}", file=sys.stderr)
        sys.exit(2)
    except ClientError as error:
        print(f"sim-client: {printable(str(error))}", file=sys.stderr)
        sys.exit(1)
    except BaseException as error:
        if interrupted:  # the interrupt may have become another error, e.g. of an import
            leave()
        if not (text := exhausted(error) or missing_extra(error)):
            raise
        print(f"sim-client: {text}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
