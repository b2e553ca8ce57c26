# SPDX-License-Identifier: MIT
"""Commands that act on bodies and obstacles."""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING, Annotated

import typer

from clients.errors import BadInput
from clients.options.common import At, Connect, Json, Object, Server, Triple
from clients.options.point import PointCommand, point
from protocol.channels import SERVER_NAME
from protocol.push_limits import ORPHANED_PUSH

if TYPE_CHECKING:
    from clients.client import Client
    from protocol import messages_pb2 as pb

MOVES_PER_SECOND = 30  # of a grab

app = typer.Typer()


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


def _nodes(count: int) -> str:
    return f"{count} node{'s' if count != 1 else ''}"


def _coordinates(point: pb.Vector) -> str:
    return f"({point.x:.4g}, {point.y:.4g}, {point.z:.4g})"


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
