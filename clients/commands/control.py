# SPDX-License-Identifier: MIT
"""Commands that halt, step, save and end a run, and change its workers."""

from __future__ import annotations

import json
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from clients.errors import BadInput
from clients.options.common import Connect, Json, Server
from protocol.channels import SERVER_NAME

if TYPE_CHECKING:
    from protocol import messages_pb2 as pb

app = typer.Typer()


class Change(StrEnum):
    add = "add"
    kill = "kill"


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


def _command(verb: str, connect: Connect, server: str, as_json: bool) -> None:
    """Sends a command that is only a verb, and prints the outcome."""
    from clients.client import Client

    with Client(server, connect) as client:
        reply = {"pause": client.pause, "resume": client.resume, "stop": client.stop}[verb]()
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
    if verb == "stop" and found.state == "running":
        said = "stops after the step under way, with"
    elif verb in ("pause", "step") and found.state != "paused":
        said = f"{found.state} at"
    elif reply.unchanged:
        said = {"pause": "already paused, at", "resume": "already running, at"}[verb]
    steps = f"{found.step} step{'s' * (found.step != 1)}" if verb == "stop" else f"step {found.step}"
    print(f"{said} {steps} (t = {found.time:.3f} s)")


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
