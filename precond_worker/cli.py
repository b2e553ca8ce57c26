# SPDX-License-Identifier: MIT
"""The command line of the worker. Nothing here imports numpy before the number of threads is set."""

import logging
import os
import socket
import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated

import typer

from precond_worker.ending import end_now, end_with_any_thread
from precond_worker.errors import DeviceUnusable, NameTaken
from protocol.process.command_line import Program, Terminated, end_in_order
from protocol.process.exhausted import exhausted
from protocol.process.nvidia import nvidia_device

if TYPE_CHECKING:
    from precond_worker.metrics import WorkerMetrics
    from precond_worker.serving import WorkerOptions

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
        from precond_worker.serving import WorkerOptions

        given = connect or [], threads, name or _default_name(), ["sim"] if server is None else server
        _serve(WorkerOptions(*given, not no_shared_memory, library, tls, metrics))
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


def _serve(options: "WorkerOptions") -> None:
    from precond_worker.factorization.block_columns import compile_ahead
    from precond_worker.main_loop import MainLoop
    from precond_worker.network.server_addresses import server_addresses
    from precond_worker.serving import Serving, identified
    from protocol.network.metrics_server import metrics_address
    from protocol.process.memory import keep_long_lived
    from protocol.process.notify import Notifier

    end_in_order()
    notifier = Notifier.of_environment()
    try:
        name, identity = identified(options)
        addresses = server_addresses(options.servers, options.connect, identity is not None)
        metrics_at = None if options.metrics is None else metrics_address(options.metrics)
    except ValueError as error:  # BadEndpoint or Refused
        PROGRAM.bad_input(str(error))
    title = library_title(options.library)
    compile_ahead()
    with ExitStack() as closing:
        collected = None if metrics_at is None else _serve_metrics(closing, metrics_at, name, title, options.threads)
        made = Serving(options, name, title, collected)
        loop = MainLoop(
            addresses, options.shared_memory, made.connection, made.worker, identity, name, made.left, notifier.alive
        )
        closing.enter_context(loop)
        keep_long_lived()
        notifier.ready(f"{title}, looking for {', '.join(options.servers)}")
        try:
            loop.run()
        finally:
            notifier.stopping()


def _serve_metrics(
    closing: ExitStack, address: tuple[str, int], name: str, title: str, threads: int
) -> "WorkerMetrics":  # fmt: skip
    """Serves metrics until `closing`; ends the program if it cannot."""
    from precond_worker.metrics import WorkerMetrics
    from protocol.network.metrics_server import MetricsServer
    from protocol.refused import Refused

    collected = WorkerMetrics(name, title, threads)
    try:
        closing.enter_context(MetricsServer(*address, collected))
    except Refused as error:
        PROGRAM.bad_input(str(error))
    return collected


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
