# SPDX-License-Identifier: MIT
"""The command line of the server."""

import logging
import os
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from protocol.network.endpoints import default_endpoint
from protocol.process.command_line import Program, Terminated, end_in_order
from protocol.process.notify import Notifier
from protocol.process.nvidia import nvidia_device
from sim_server.certificates.in_use import Certificates
from sim_server.errors import DeviceError, DeviceLost, InputError, NameTaken
from sim_server.service.compile_notice import compile_notices
from sim_server.service.web_page import WebCommand

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


def list_gallery(asked: bool) -> None:
    """Option --list: shows the scenes that come along in a table, and ends."""
    if not asked:
        return
    from rich.console import Console
    from rich.table import Table

    from sim_server.scene import gallery, load

    table = Table("name", "what", "elements", "command", box=None, pad_edge=False)
    table.columns[2].justify, table.columns[3].no_wrap = "right", True
    for name in gallery.names():
        file = gallery.FOLDER / f"{name}.toml"
        try:
            elements = sum(len(o.load_mesh().tets) for o in load(file).objects)
        except InputError as error:
            PROGRAM.bad_input(f"{file}: {error}")
        table.add_row(name, gallery.sentence(name), str(elements), f"sim-server {gallery.name_of(file)} --workers 1")
    Console().print(table)
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
    record: Annotated[Path | None, typer.Option(metavar="FILE.mcap", help="Write a log (replaces the file)")] = None,
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
    if device not in ("auto", "cpu", "gpu"):
        PROGRAM.bad_input(f"--device {device}: allowed are auto, cpu, gpu")
    if worker_device not in ("auto", "cpu", "gpu"):
        PROGRAM.bad_input(f"--worker-device {worker_device}: allowed are auto, cpu, gpu")
    say = (lambda text: None) if quiet else (lambda text: print(f"sim-server: {text}", flush=True))
    if json and not explain:
        PROGRAM.bad_input("--json goes with --explain alone")
    if explain:
        explain_scene(scene, set_ or [], device, name, json)
        return
    service: Service | None = None
    code = 0
    notifier = Notifier.of_environment()
    try:
        options = Options(
            scene, set_ or [], choose_device(device, say), name, listen, connect, not no_shared_memory, record, steps,
            realtime, workers, worker_device, web, quiet, resume, tls, insecure, metrics, record_rotate or [],
            record_keep, max_objects, max_memory,
        )  # fmt: skip
        with ExitStack() as closing:
            with nullcontext() if quiet else compile_notices(say):
                service, supervisor = _set_up(closing, options)
            service.say = say
            _announce(say, service, scene, listen or [default_endpoint(tls is not None)])
            _wait_for_workers(service, supervisor)
            _describe_objects(say, service, listen, tls)
            service.health.notifier = notifier
            notifier.ready(f"{scene.name} on {', '.join(listen or ['loopback'])}")
            try:
                service.run()
            finally:
                notifier.stopping()
                say(_summary(service))
    except NameTaken as error:
        PROGRAM.bad_input(str(error))
    except KeyboardInterrupt:
        code = 130
    except Terminated:
        pass
    except DeviceLost as error:
        print(f"sim-server: {error}", file=sys.stderr)
        code = 1
    if service is not None and service.recorder is not None and service.recorder.failure:
        print(f"sim-server: exit code 1: the log {record} is not whole", file=sys.stderr)
        code = 1
    raise typer.Exit(code)


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


def choose_device(device: str, say: Callable[[str], None]) -> str:
    """Returns the device to run on; auto: the GPU if there is a usable one. Reports why a GPU is not usable."""
    if device != "auto":
        return device
    if not nvidia_device():
        return "cpu"
    from sim_server.backends.gpu.device import cupy

    try:
        cupy()
    except DeviceError as error:
        say(f"on the CPU; {error}")
        return "cpu"
    return "gpu"


@dataclass(frozen=True)
class Options:
    """Values of the command line."""

    scene: Path
    overrides: list[str]
    device: str
    name: str
    listen: list[str] | None
    connect: list[str] | None
    shared_memory: bool
    record: Path | None
    steps: int | None
    realtime: bool
    workers: int
    worker_device: str
    web: str | None
    quiet: bool
    resume: Path | None
    tls: str | None
    insecure: bool
    metrics: str | None
    record_rotate: list[str]
    record_keep: str | None
    max_objects: int | None
    max_memory: str | None


def _set_up(closing: ExitStack, o: Options) -> "tuple[Service, Supervisor | None]":
    """Builds simulation, link, recorder and workers; exits with code 2 on bad input."""
    from protocol.network.endpoints import BadEndpoint
    from protocol.network.exposure import unrestricted
    from protocol.network.metrics_server import metrics_address
    from protocol.network.session import AddressInUse, ConnectionFailed
    from protocol.refused import Refused
    from sim_server.backends.compiler import CompileError, ahead
    from sim_server.checkpoint.file import read
    from sim_server.network.link import ServerLink
    from sim_server.recording.recorder import Recorder
    from sim_server.recording.rotation import Rotation
    from sim_server.scene.size_limits import SizeLimits
    from sim_server.service.service import Service
    from sim_server.service.supervisor import Supervisor
    from sim_server.service.web_page import WebPage
    from sim_server.simulation import Simulation

    end_in_order()
    try:
        certificates = Certificates(
            o.tls, o.listen, o.connect, o.insecure, workers=o.workers > 0, web=o.web is not None
        )
        page = _page_address(o.web)
        rotation = Rotation.of_options(o.record_rotate, o.record_keep)
        if (o.record_rotate or o.record_keep) and o.record is None:
            raise InputError("--record-rotate and --record-keep go with --record")
        metrics = None if o.metrics is None else metrics_address(o.metrics)
        checkpoint = None if o.resume is None else read(o.resume)
        limits = SizeLimits.of_options(o.max_objects, o.max_memory)
        ahead("recording/wire.cpp")
        simulation = Simulation.load(o.scene, o.overrides, o.device, limits)
        link = closing.enter_context(
            ServerLink(o.name, o.listen, o.connect, shared_memory=o.shared_memory, tls=certificates.server)
        )
        recorder = None
        if o.record is not None:
            _check_log_path(o.record)
            compression = simulation.scene.record.compression
            recorder = closing.enter_context(
                Recorder(o.record, compression, overwrite=True, report=logging.error, rotation=rotation)
            )
        try:
            service = Service(simulation, link, recorder, o.steps, o.realtime, checkpoint)
        except InputError as error:
            raise InputError(f"--resume {o.resume}: {error}" if o.resume else str(error)) from None
        if metrics is not None:
            _serve_metrics(closing, service, *metrics)
    except AddressInUse as error:
        PROGRAM.bad_input(f"{error}; is another sim-server there? --listen tcp/127.0.0.1:7448 takes another port")
    except (InputError, BadEndpoint, ConnectionFailed, Refused, CompileError) as error:
        PROGRAM.bad_input(str(error))
    for endpoint in unrestricted([*(o.listen or []), *(o.connect or [])], o.tls is not None):
        logging.warning(
            "--insecure: %s: anybody who reaches it may stop this server, and push, grab and pause; docs/security.md "
            "tells how to keep others out", endpoint
        )  # fmt: skip
    supervisor = None
    if o.workers and not simulation.scene.integrator.explicit:  # which needs none
        endpoint = certificates.local_endpoint
        of_workers = ["--device", o.worker_device, *certificates.for_worker]
        if not link.shared_memory:  # which was told, once
            of_workers.append("--no-shared-memory")
        supervisor = Supervisor(o.workers, o.name, [endpoint], of_workers)
        closing.callback(supervisor.close)
        service.supervise(supervisor)
    if page is not None:
        web = WebPage(o.name, certificates.local_endpoint, *page, quiet=o.quiet, options=certificates.for_client)
        closing.callback(web.close)
        service.check_page = web.check
    return service, supervisor


def _serve_metrics(closing: ExitStack, service: "Service", host: str, port: int) -> None:
    """Serves metrics until `closing` closes. Raises Refused if they cannot be served there."""
    from protocol.network.metrics_server import MetricsServer
    from sim_server.service.metrics import ServerMetrics

    names = [body.name for body in service.simulation.world.bodies]
    found = ServerMetrics(names, service.link, service.recorder, lambda: service.need.lost)
    closing.enter_context(MetricsServer(host, port, found, service.health.why_not))
    service.telemetry.metrics = found
    service.telemetry.publish_status("running")


def _page_address(web: str | None) -> tuple[str, int] | None:
    """Returns host and port of the page, None without one. Raises InputError if it cannot be served there."""
    from protocol.network.web_address import hindrance, web_address

    if web is None:
        return None
    host, port = web_address(web)
    if why := hindrance(host, port):
        raise InputError(f"--web: {why}")
    return host, port


def _check_log_path(path: Path) -> None:
    """Raises InputError if something other than a log would be replaced."""
    if path.is_file() and path.stat().st_size:
        with path.open("rb") as file:
            if file.read(8) != b"\x89MCAP0\r\n":
                raise InputError(f"--record {path}: this file exists and is no MCAP log; it is left as it is")


def _announce(say, service: "Service", scene: Path, listen: list[str]) -> None:  # type: ignore[no-untyped-def]
    world, solver = service.simulation.world, service.simulation.scene.solver
    tets = sum(len(b.mesh.tets) for b in world.bodies)
    say(
        f"{scene.name}: {len(world.bodies)} object{'s' * (len(world.bodies) > 1)}, {world.nodes} nodes, {tets} tets, "
        f"dt {world.dt:g} s, preconditioner {solver.preconditioner}, update {solver.update}; {world.backend.name}; "
        f"listening on {', '.join(listen)}"
    )


def _describe_objects(  # type: ignore[no-untyped-def]
    say, service: "Service", listen: list[str] | None, tls: str | None
) -> None:
    """Reports size and mass of each object, where a mesh in millimetres or a density in g/cm3 shows, and notes."""
    from sim_server.service.scene_notes import scene_notes

    world = service.simulation.world
    for body in world.bodies[:20]:
        size = " x ".join(f"{s:.3g}" for s in body.mesh.rest.max(axis=0) - body.mesh.rest.min(axis=0))
        say(f"  {body.name}: {body.last - body.first} nodes, {size} m, {world.mass[body.nodes].sum():.3g} kg")
    for line in scene_notes(service.simulation):
        say(f"note: {line}")
    if service.driver.wants_factors and service.driver.policy.free and not service.link.dispatch.workers():
        say(
            "no worker is there, so nothing makes factors and solves use block Jacobi; start one in a second terminal, "
            f"{_worker_command(service.link.name, listen, tls)}, or this server with --workers 1"
        )


def _worker_command(name: str, listen: list[str] | None, tls: str | None) -> str:
    """Returns the command that starts a worker for this server on this machine."""
    from protocol.channels import DEFAULT_ENDPOINT, SERVER_NAME
    from protocol.network.endpoints import on_this_machine

    words = ["precond-worker"]
    if listen and listen[0] != DEFAULT_ENDPOINT:
        words += ["--connect", on_this_machine(listen[0])]
    if name != SERVER_NAME:
        words += ["--server", name]
    if tls is not None:
        words += ["--tls", tls]
    return " ".join(words)


def _wait_for_workers(service: "Service", supervisor: "Supervisor | None") -> None:
    """Waits for the first local worker, WORKER_TIMEOUT at most."""
    end = time.monotonic() + WORKER_TIMEOUT
    while supervisor is not None and not service.link.dispatch.workers() and time.monotonic() < end:
        supervisor.check()
        service.link.check_name()
        time.sleep(0.02)


def _summary(service: "Service") -> str:
    p50, p99, most = (1e3 * s for s in service.telemetry.percentiles())
    used = sum(state.factors.used for state in service.driver.bodies)
    return (
        f"{service.engine.step} steps; last {len(service.telemetry.seconds)}: p50 {p50:.3f}, p99 {p99:.3f}, "
        f"max {most:.3f} ms; {used} factors used, {service.engine.loop.late_steps} late steps; "
        f"{_unconverged(service)}{_runaways(service)}"
    )


def _unconverged(service: "Service") -> str:
    """Returns how many solves did not reach the tolerance, by cause."""
    counts = service.telemetry.unconverged
    if not counts:
        return "all solves converged"
    why = ", ".join(f"{n} {status}" for status, n in counts.most_common())
    return f"{sum(counts.values())} of {service.telemetry.solves} solves not converged ({why})"


def _runaways(service: "Service") -> str:
    """Returns the names of objects that have run away; empty if none have."""
    names = [service.simulation.world.bodies[body].name for body in sorted(service.telemetry.runaways)]
    return f"; run away: {', '.join(names[:20])}" if names else ""


def main() -> None:
    """Entry point of the console script. `certs` is a program of its own: SCENE.toml has no commands beside it."""
    if sys.argv[1:2] == ["certs"]:
        from sim_server.certificates import command

        sys.argv[1:2] = []
        command.PROGRAM.run(command.app)
        return
    PROGRAM.run(app)
