# SPDX-License-Identifier: MIT
"""The command line of the server."""

import logging
import os
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from protocol.network.endpoints import default_endpoint
from protocol.process.command_line import Program, Terminated, end_in_order, held_signals
from protocol.process.memory import keep_long_lived
from protocol.process.notify import Notifier
from sim_server.errors import DeviceLost, InputError
from sim_server.service.compile_notice import compile_notices
from sim_server.service.web_page import WebCommand
from sim_server.startup.device import choose_device
from sim_server.startup.options import Options

if TYPE_CHECKING:
    from sim_server.service.service import Service
    from sim_server.service.supervisor import Supervisor

PROGRAM = Program("sim-server")
app = typer.Typer(pretty_exceptions_enable=False, rich_markup_mode=None)

EPILOG = """\b
Examples:
  sim-server gallery/creature --workers 1
        a scene that comes along; sim-server --list tells them
  sim-server deploy/scenes/beam.toml --workers 1
        in real time, helped by one local worker
  sim-server beam.toml --workers 1 --web
        with a page in the browser where it is dragged
  sim-server beam.toml --steps 500 --free-run --record beam.mcap
        as fast as it goes, with a log
  sim-server certs certs --host sim.example.org
  sim-server beam.toml --tls certs --listen tls/0.0.0.0:7447
        open to workers and clients on other machines that have certificates
  sim-server beam.toml --set solver.tolerance=1e-8 --set dt=0.01
        with other values than the scene's
  sim-server beam.toml --set @beam.plan.toml
        with those that the file lists
  sim-server beam.toml --explain
        what each effect of the scene asks for: launches, memory, keys, ...
"""

WORKER_TIMEOUT = 15.0  # s that the start waits for the first local worker, at most
READY_TIMEOUT = 3.0  # s that it then waits until worker and device are ready for the first factors, at most


def list_gallery(asked: bool) -> None:
    """Option --list: shows the scenes that come along in a table, and ends."""
    if not asked:
        return
    from rich.console import Console
    from rich.table import Table

    from sim_server.scene import gallery, load

    table = Table("name", "what", "elements", box=None, pad_edge=False)
    table.columns[0].no_wrap, table.columns[2].justify = True, "right"
    for name in gallery.names():
        file = gallery.FOLDER / f"{name}.toml"
        try:
            elements = sum(len(o.load_mesh().tets) for o in load(file).objects)
        except InputError as error:
            PROGRAM.bad_input(f"{file}: {error}")
        table.add_row(str(gallery.name_of(file)), gallery.sentence(name), str(elements))
    Console().print(table)
    print("\nTo run one in a browser: sim-server NAME --workers 1 --web")
    raise typer.Exit


def print_schema(asked: bool) -> None:
    """Option --schema: prints the JSON schema of scenes, and ends."""
    if not asked:
        return
    from json import dumps

    from sim_server.scene.json_schema import scene_schema

    print(dumps(scene_schema(), indent=1))
    raise typer.Exit


@app.command(epilog=EPILOG, cls=WebCommand)
def serve(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="What to simulate; or gallery/NAME")],
    device: Annotated[
        str, typer.Option(metavar="auto|cpu|gpu", help="Where; auto: the GPU if there is a usable one, else the CPU")
    ] = "auto",
    steps: Annotated[int | None, typer.Option(metavar="N", min=1, help="Stop after N steps")] = None,
    realtime: Annotated[
        bool, typer.Option("--realtime/--free-run", help="Keep pace with the clock, or as fast as it goes")
    ] = True,
    record: Annotated[
        Path | None,
        typer.Option(metavar="FILE.mcap", help="Write a log (replaces the file); {time} in its name: of the start"),
    ] = None,
    record_rotate: Annotated[
        list[str] | None,
        typer.Option(metavar="SIZE|TIME", help="Go on in a new file after so much, as 500MB or 1h; may be repeated"),
    ] = None,
    record_keep: Annotated[
        str | None, typer.Option(metavar="SIZE", help="Remove the oldest files of the log beyond so much, as 20GB")
    ] = None,
    resume: Annotated[Path | None, typer.Option(metavar="FILE", help="Go on where sim-client save saved this")] = None,
    connect: Annotated[list[str] | None, typer.Option(metavar="EP", help="Link with another server or router")] = None,
    listen: Annotated[
        list[str] | None, typer.Option(metavar="EP", help="Where to be reached [default: tcp/127.0.0.1:7447]")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE|@FILE", help="Another value than the scene's, or a file of them"),
    ] = None,
    workers: Annotated[int, typer.Option(metavar="N", min=0, max=64, help="Local workers to start and supervise")] = 0,
    worker_device: Annotated[
        str, typer.Option(metavar="auto|cpu|gpu", help="What local workers factorize on (precond-worker --device)")
    ] = "cpu",
    web: Annotated[
        str | None,
        typer.Option(
            metavar="[HOST:PORT]", help="Serve a page where bodies are dragged (sim-client web), at 127.0.0.1:8080"
        ),
    ] = None,
    metrics: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Serve metrics for Prometheus; PORT alone: of this machine"),
    ] = None,
    max_objects: Annotated[int | None, typer.Option(metavar="N", min=1, help="Refuse scenes with more objects")] = None,
    max_memory: Annotated[
        str | None, typer.Option(metavar="SIZE", help="Refuse scenes that need more, by an estimate, as 4GB")
    ] = None,
    name: Annotated[str, typer.Option(metavar="NAME", help="Name of this server in all keys")] = "sim",
    tls: Annotated[
        str | None, typer.Option(metavar="DIR", help="Ask for certificates; the folder that sim-server certs made")
    ] = None,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Let everybody in who reaches --listen, also from other machines")
    ] = False,
    no_shared_memory: Annotated[bool, typer.Option("--no-shared-memory", help="Send arrays as bytes")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="Say nothing but errors")] = False,
    explain: Annotated[
        bool, typer.Option("--explain", help="Show what each effect of the scene asks for, and end; no step is made")
    ] = False,
    json: Annotated[bool, typer.Option("--json", help="Of --explain: as JSON on one line")] = False,
    list_: Annotated[
        bool,
        typer.Option("--list", callback=list_gallery, is_eager=True, help="Show the scenes that come along"),
    ] = False,
    schema: Annotated[
        bool,
        typer.Option(
            "--schema", callback=print_schema, is_eager=True, help="Print a JSON schema of scenes, for editors"
        ),
    ] = False,
    version: Annotated[bool, PROGRAM.version_option()] = False,
) -> None:
    """Simulate the objects of a scene, helped by preconditioner workers, open to clients."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    logging.basicConfig(level=logging.ERROR if quiet else logging.WARNING, format="sim-server: %(message)s")
    for option, given in (("--device", device), ("--worker-device", worker_device)):
        if given not in ("auto", "cpu", "gpu"):
            PROGRAM.bad_input(f"{option} {given}: allowed are auto, cpu, gpu")
    if json and not explain:
        PROGRAM.bad_input("--json goes with --explain alone")
    if explain:
        explain_scene(scene, set_ or [], device, name, json)
        return
    say = (lambda text: None) if quiet else (lambda text: print(f"sim-server: {text}", flush=True))
    options = Options(
        scene, set_ or [], choose_device(device, say), name, listen, connect, not no_shared_memory, record, steps,
        realtime, workers, worker_device, web, quiet, resume, tls, insecure, metrics, record_rotate or [],
        record_keep, max_objects, max_memory,
    )  # fmt: skip
    raise typer.Exit(run(options, say))


def run(o: Options, say: Callable[[str], None]) -> int:
    """Runs a server until it has made its steps or is stopped; returns the exit code. say: prints a line"""
    from sim_server.startup.console import announce, describe_objects, summary
    from sim_server.startup.set_up import set_up

    service: Service | None = None
    code, notifier = 0, Notifier.of_environment()
    end_in_order()
    try:
        with ExitStack() as closing:
            with nullcontext() if o.quiet else compile_notices(say):
                service, supervisor = set_up(closing, o)
            service.say = say
            announce(say, service, o.scene, o.listen or [default_endpoint(o.tls is not None)])
            wait_for_workers(service, supervisor)
            keep_long_lived()
            describe_objects(say, service, o.listen, o.tls)
            service.health.notifier = notifier
            notifier.ready(f"{o.scene.name} on {', '.join(o.listen or ['loopback'])}")
            try:
                with held_signals() as is_told_to_end:
                    service.run(is_told_to_end)
            finally:
                notifier.stopping()
                say(summary(service))
    except InputError as error:
        PROGRAM.bad_input(str(error))
    except KeyboardInterrupt:
        code = 130
    except Terminated:
        pass
    except DeviceLost as error:
        print(f"sim-server: {error}", file=sys.stderr)
        code = 1
    if service is not None and service.recorder is not None and service.recorder.failure:
        print(f"sim-server: exit code 1: the log {service.recorder.path} is not whole", file=sys.stderr)
        code = 1
    return code


def explain_scene(scene: Path, overrides: list[str], device: str, name: str, json: bool) -> None:
    """Shows what each effect of a scene asks for (--explain); exits with code 2 on bad input."""
    from protocol.channels import check_name
    from protocol.refused import Refused
    from sim_server.backends.compiler import CompileError
    from sim_server.explain.explanation import explain

    try:
        found = explain(scene, overrides, choose_device(device, lambda text: None), check_name(name, "--name"))
    except (InputError, CompileError, Refused) as error:
        PROGRAM.bad_input(str(error))
    if json:
        from json import dumps

        print(dumps(found.json()))
        return
    from sim_server.explain.tables import show

    show(found)


def wait_for_workers(service: "Service", supervisor: "Supervisor | None") -> None:
    """Waits for the first local worker, WORKER_TIMEOUT at most, and then until all is ready for the first factors,
    READY_TIMEOUT at most."""
    if supervisor is None:
        return
    for there, seconds in ((service.link.dispatch.workers, WORKER_TIMEOUT), (service.ready, READY_TIMEOUT)):
        end = time.monotonic() + seconds
        while not there():
            if time.monotonic() > end:
                return
            supervisor.check()
            service.link.check_name()
            time.sleep(0.01)


def main() -> None:
    """Entry point of the console script. `certs` is a program of its own: SCENE.toml has no commands beside it."""
    if sys.argv[1:2] == ["certs"]:
        from sim_server.certificates import command

        sys.argv[1:2] = []
        command.PROGRAM.run(command.app)
        return
    PROGRAM.run(app)
