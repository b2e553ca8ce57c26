# SPDX-License-Identifier: MIT
"""The command line of the worker. Nothing here imports numpy before the number of threads is set."""

import logging
import os
import socket
import sys
from threading import Event
from typing import TYPE_CHECKING, Annotated

import typer

from precond_worker.ending import end_now, end_with_any_thread
from precond_worker.errors import DeviceUnusable, NameTaken
from protocol.process.command_line import Program, Terminated, end_in_order
from protocol.process.exhausted import exhausted
from protocol.process.nvidia import nvidia_device

if TYPE_CHECKING:
    from protocol.shared_memory.device_probe import OpenedMemory

PROGRAM = Program("precond-worker")
app = typer.Typer(pretty_exceptions_enable=False, rich_markup_mode=None)

EPILOG = """\b
Examples:
  precond-worker
        for a server on this machine
  precond-worker --connect tcp/10.0.0.5:7447 --threads 4 --name big-box
        for a server elsewhere, with four threads
  precond-worker --server sim-0@tcp/10.0.0.5:7447 --server sim-1@tcp/10.0.0.6:7447
        shared by two servers, a job of each in turn
  precond-worker --connect tcp/10.0.0.1:7447 --server '*'
        for every server on the network of that router, those to come too
  precond-worker --device auto
        on the GPU of this machine if it has a usable one
  precond-worker --no-shared-memory
        arrays as bytes, also on this machine
"""


@app.command(epilog=EPILOG)
def work(
    connect: Annotated[
        list[str] | None,
        typer.Option(
            metavar="EP",
            help="Endpoint of the server, may be repeated [default: WARPFACTOR_CONNECT or tcp/127.0.0.1:7447]",
        ),
    ] = None,
    device: Annotated[
        str, typer.Option(metavar="auto|cpu|gpu", help="What factorizes; auto: an NVIDIA GPU if it is usable")
    ] = "cpu",
    precision: Annotated[
        str,
        typer.Option(metavar="auto|float32|float64", help="On the GPU; auto: float32 where float64 is slow"),
    ] = "auto",
    arithmetic: Annotated[str | None, typer.Option("--arithmetic", hidden=True)] = None,
    threads: Annotated[int, typer.Option(metavar="N", min=1, max=1024, help="Threads of the linear algebra")] = 1,
    name: Annotated[str, typer.Option(metavar="NAME", help="Name, unique on its server [default: HOST-PID]")] = "",
    server: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[@EP]", help="Server to work for, may be repeated; '*': every server found [default: sim]"
        ),
    ] = None,
    tls: Annotated[
        str | None,
        typer.Option(
            metavar="DIR", help="Folder of a certificate, as sim-server certs makes it [default: WARPFACTOR_TLS]"
        ),
    ] = None,
    metrics: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="Serve metrics for Prometheus; PORT alone: of this machine"),
    ] = None,
    no_shared_memory: Annotated[bool, typer.Option("--no-shared-memory", help="Send arrays as bytes")] = False,
    exit_with_parent: Annotated[
        bool, typer.Option("--exit-with-parent", help="End when the parent process ends")
    ] = False,
    parent: Annotated[int | None, typer.Option("--parent", hidden=True, help="Its process id")] = None,
    verbose: Annotated[bool, typer.Option("--verbose", help="Say more on standard error")] = False,
    version: Annotated[bool, PROGRAM.version_option()] = False,
) -> None:
    """Factorize the matrices of a simulation server, until SIGTERM or Ctrl-C."""
    if arithmetic is not None:
        print(f"{PROGRAM.name}: --arithmetic is called --precision now", file=sys.stderr)
        precision = arithmetic
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = str(threads)
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, format="%(name)s: %(message)s")
    end_with_any_thread()
    try:
        if exit_with_parent:
            from protocol.process.die_with_parent import die_with_parent

            die_with_parent(parent)
        library = chosen_library(device, precision)
        servers = ["sim"] if server is None else server
        _serve(connect or [], threads, name or _default_name(), servers, not no_shared_memory, library, tls, metrics)
    except NameTaken as error:
        PROGRAM.bad_input(str(error))
    except DeviceUnusable as error:
        print(f"precond-worker: {error}", file=sys.stderr)
        raise typer.Exit(1) from None
    except KeyboardInterrupt:
        raise typer.Exit(130) from None
    except Terminated:
        raise typer.Exit(0) from None
    except BaseException as error:
        if why := exhausted(error):
            end_now(why)
        raise


def _default_name() -> str:
    host = "".join(c if c.isascii() and (c.isalnum() or c in "_.-") else "-" for c in socket.gethostname())
    return f"{host[:50]}-{os.getpid()}"


def chosen_library(device: str, precision: str) -> str:
    """Returns the library for Analysis; ends the program if it cannot work here."""
    if device not in ("auto", "cpu", "gpu"):
        PROGRAM.bad_input(f"--device {device}: allowed are auto, cpu, gpu")
    if precision not in ("auto", "float32", "float64"):
        PROGRAM.bad_input(f"--precision {precision}: allowed are auto, float32, float64")
    if device == "cpu":
        return "auto"
    if device == "auto" and not nvidia_device():
        return "auto"
    from precond_worker.gpu.device import try_out

    try:
        try_out(precision)
    except DeviceUnusable as error:
        if device == "gpu":
            PROGRAM.bad_input(f"--device gpu: {error}")
        print(f"precond-worker: --device auto takes the CPU: {error}", file=sys.stderr, flush=True)
        return "auto"
    return "gpu" if precision == "auto" else f"gpu-{precision}"


def _serve(
    connect: list[str], threads: int, name: str, servers: list[str], shared_memory: bool, library: str,
    tls: str | None, metrics: str | None,
) -> None:  # fmt: skip
    from contextlib import ExitStack
    from functools import partial

    from precond_worker.factorization.block_columns import compile_ahead
    from precond_worker.factorization.registry import make_factorization
    from precond_worker.main_loop import MainLoop
    from precond_worker.network.server_addresses import ServerAddress, server_addresses
    from precond_worker.network.server_connection import ServerConnection
    from precond_worker.worker import Worker
    from protocol.access.roles import identity_in, own_name
    from protocol.channels import check_name
    from protocol.counters import Counters
    from protocol.network.endpoints import given_endpoints
    from protocol.network.identity import usual_identity
    from protocol.network.metrics_server import MetricsServer, metrics_address
    from protocol.network.session import Session
    from protocol.process.memory import keep_long_lived
    from protocol.process.notify import Notifier
    from protocol.refused import Refused

    end_in_order()
    notifier = Notifier.of_environment()
    try:
        own = [server.partition("@")[2] for server in servers if "@" in server]
        identity = usual_identity(tls, ("worker",), [*connect, *own] or given_endpoints())
        if identity is not None and identity.role != "worker":
            text = f"the certificate {identity.name!r} was made for a {identity.role}"
            print(f"precond-worker: {text}: a server that has it as one gives it no jobs", file=sys.stderr, flush=True)
        if identity is not None and identity_in(name) != identity.name:
            name = own_name(identity.name, name[len(identity.name) - 63 :])  # its end tells workers apart
        check_name(name, "--name")
        where = server_addresses(servers, connect, identity is not None)
        metrics_at = None if metrics is None else metrics_address(metrics)
    except ValueError as error:  # BadEndpoint or Refused
        PROGRAM.bad_input(str(error))
    shown = library_title(library)
    compile_ahead()
    closing = ExitStack()
    collected = None
    if metrics_at is not None:
        from precond_worker.metrics import WorkerMetrics

        collected = WorkerMetrics(name, shown, threads)
        try:
            closing.enter_context(MetricsServer(*metrics_at, collected))
        except Refused as error:
            PROGRAM.bad_input(str(error))

    def connection(session: Session, server: str, wake: Event) -> ServerConnection:
        made = ServerConnection(
            session, server, name, threads, shown, Counters(logging.getLogger("precond_worker")), wake,
            opened_memory(library) if shared_memory else None,
        )  # fmt: skip
        if collected is not None:
            collected.connections.append(made)
        return made

    def worker(connected: ServerConnection, address: ServerAddress) -> Worker:
        def on_server(found: bool) -> None:
            server = f"server {connected.server} at {address}"
            if found:
                count = f"{threads} thread{'s' if threads > 1 else ''}"
                memory = "shared memory" if connected.shared_memory else "no shared memory"
                print(f"precond-worker {name} ready: {shown}, {count}, {memory}, {server}", flush=True)
            else:
                print(f"precond-worker {name}: {server} is gone, waiting for it", file=sys.stderr, flush=True)

        observe = (lambda seconds: None) if collected is None else collected.factorization.observe
        return Worker(connected, partial(make_factorization, library=library), on_server, observe)

    def left(connected: ServerConnection) -> None:
        print(f"precond-worker {name}: leaves server {connected.server}, others need it more", flush=True)
        if collected is not None:
            collected.connections.remove(connected)

    with closing, MainLoop(
        where, shared_memory, connection, worker, identity, name, left, notifier.alive
    ) as serving:  # fmt: skip
        keep_long_lived()
        notifier.ready(f"{shown}, looking for {', '.join(servers)}")
        try:
            serving.run()
        finally:
            notifier.stopping()


def opened_memory(library: str) -> "OpenedMemory | None":
    """Returns what opens device memory of servers; None: the library is one of the CPU."""
    if not library.startswith("gpu"):
        return None
    from precond_worker.gpu.opened_memory import OpenedDeviceMemory

    return OpenedDeviceMemory()


def library_title(library: str) -> str:
    """Names the library that is used, ready for the first factor; ends the program if it cannot be compiled."""
    if library.startswith("gpu"):
        from precond_worker.gpu.gpu_factorization import title

        return title(library.removeprefix("gpu").removeprefix("-") or "auto")
    from precond_worker.factorization.factorize import default_library

    name = default_library()
    if name == "supernodal":
        from precond_worker.factorization.supernodal import native
        from sim_server.backends.build_pool import CompileError

        try:
            native()
        except CompileError as error:
            PROGRAM.bad_input(f"complete factors need a C++ compiler: {error}")
    return name


def main() -> None:
    """Entry point of the console script."""
    PROGRAM.run(app)
