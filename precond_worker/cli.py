# SPDX-License-Identifier: MIT
"""The command line of the worker. Nothing here imports numpy before the number of threads is set."""

import logging
import os
import signal
import socket
import sys
from threading import Event
from typing import Annotated, NoReturn

import typer

from precond_worker.ending import end_now, end_with_any_thread
from precond_worker.errors import DeviceUnusable, NameTaken
from protocol.exhausted import exhausted
from protocol.interrupted import handle, run_command
from protocol.nvidia import nvidia_device

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


def _version(asked: bool) -> None:
    if asked:
        from protocol.version import version

        print(f"precond-worker {version()}")
        raise typer.Exit


class Terminated(BaseException):
    """SIGTERM: leave in good order."""


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
    arithmetic: Annotated[
        str,
        typer.Option(metavar="auto|float32|float64", help="On the GPU; auto: float32 where float64 is slow"),
    ] = "auto",
    threads: Annotated[int, typer.Option(metavar="N", min=1, max=1024, help="Threads of the linear algebra")] = 1,
    name: Annotated[str, typer.Option(metavar="NAME", help="Name, unique on its server [default: HOST-PID]")] = "",
    server: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[@EP]", help="Server to work for, may be repeated; '*': every server found [default: sim]"
        ),
    ] = None,
    no_shared_memory: Annotated[bool, typer.Option("--no-shared-memory", help="Send arrays as bytes")] = False,
    exit_with_parent: Annotated[
        bool, typer.Option("--exit-with-parent", help="End when the parent process ends")
    ] = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="Say more on standard error")] = False,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Say which version this is, and end")
    ] = False,
) -> None:
    """Factorize the matrices of a simulation server, until SIGTERM or Ctrl-C."""
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = str(threads)
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, format="%(name)s: %(message)s")
    end_with_any_thread()
    try:
        if exit_with_parent:
            from precond_worker.parent import end_with_parent

            end_with_parent()
        library = _library(device, arithmetic)
        servers = ["sim"] if server is None else server
        _serve(connect or [], threads, name or _default_name(), servers, not no_shared_memory, library)
    except NameTaken as error:
        _bad_input(str(error))
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


def _end_in_order() -> None:
    """From now on Ctrl-C and SIGTERM close what is open; before, they end the program at once (__main__.py)."""
    handle(signal.SIGINT, signal.default_int_handler)
    handle(signal.SIGTERM, _terminate)


def _terminate(*_: object) -> None:
    raise Terminated


def _default_name() -> str:
    host = "".join(c if c.isascii() and (c.isalnum() or c in "_.-") else "-" for c in socket.gethostname())
    return f"{host[:50]}-{os.getpid()}"


def _library(device: str, arithmetic: str) -> str:
    """What Analysis is to use; ends the program if that cannot work here."""
    if device not in ("auto", "cpu", "gpu"):
        _bad_input(f"--device {device}: allowed are auto, cpu, gpu")
    if arithmetic not in ("auto", "float32", "float64"):
        _bad_input(f"--arithmetic {arithmetic}: allowed are auto, float32, float64")
    if device == "cpu":
        return "auto"
    if device == "auto" and not nvidia_device():
        return "auto"
    from precond_worker.gpu.device import try_out

    try:
        try_out(arithmetic)
    except DeviceUnusable as error:
        if device == "gpu":
            _bad_input(f"--device gpu: {error}")
        print(f"precond-worker: --device auto takes the CPU: {error}", file=sys.stderr, flush=True)
        return "auto"
    return "gpu" if arithmetic == "auto" else f"gpu-{arithmetic}"


def _serve(connect: list[str], threads: int, name: str, servers: list[str], shared_memory: bool, library: str) -> None:
    from functools import partial

    from precond_worker.block_columns import prepare
    from precond_worker.methods import prepared
    from precond_worker.places import Place, places
    from precond_worker.serving import Serving
    from precond_worker.uplink import Uplink
    from precond_worker.worker import Worker
    from protocol.channels import check_name
    from protocol.counters import Counters
    from protocol.session import Session

    _end_in_order()
    try:
        check_name(name, "--name")
        where = places(servers, connect)
    except ValueError as error:  # BadEndpoint or Refused
        _bad_input(str(error))
    shown = _shown(library)
    prepare()

    def uplink(session: Session, server: str, bell: Event) -> Uplink:
        return Uplink(session, server, name, threads, shown, Counters(logging.getLogger("precond_worker")), bell)

    def worker(up: Uplink, place: Place) -> Worker:
        def on_server(found: bool) -> None:
            server = f"server {up.server} at {place}"
            if found:
                count = f"{threads} thread{'s' if threads > 1 else ''}"
                memory = "shared memory" if up.shared_memory else "no shared memory"
                print(f"precond-worker {name} ready: {shown}, {count}, {memory}, {server}", flush=True)
            else:
                print(f"precond-worker {name}: {server} is gone, waiting for it", file=sys.stderr, flush=True)

        return Worker(up, partial(prepared, library=library), on_server)

    with Serving(where, shared_memory, uplink, worker) as serving:
        serving.run()


def _shown(library: str) -> str:
    """What the worker says that it works with. On the CPU without CHOLMOD it also says what that costs."""
    if library.startswith("gpu"):
        from precond_worker.gpu.library import title

        return title(library.removeprefix("gpu").removeprefix("-") or "auto")
    from precond_worker.factorize import default_library

    name, remark = default_library()
    if remark:
        print(f"precond-worker: {remark}", file=sys.stderr)
    return name


def _bad_input(text: str) -> NoReturn:
    print(f"precond-worker: {text}", file=sys.stderr)
    raise typer.Exit(2)


def main() -> None:
    """Entry point of the console script."""
    run_command(app, "precond-worker")
