# SPDX-License-Identifier: MIT
"""The command line of the worker. Nothing here imports numpy before the number of threads is set."""

import logging
import os
import signal
import socket
import sys
from typing import Annotated, NoReturn

import typer

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)

EPILOG = """\b
Examples:
  precond-worker
        for a server on this machine
  precond-worker --connect tcp/10.0.0.5:7447 --threads 4 --name big-box
        for a server elsewhere, with four threads
  precond-worker --no-shared-memory
        arrays as bytes, also on this machine
"""


class Terminated(BaseException):
    """SIGTERM: leave in good order."""


@app.command(epilog=EPILOG)
def work(
    connect: Annotated[
        list[str] | None,
        typer.Option(metavar="EP", help="Endpoint of the server, may be repeated [default: tcp/127.0.0.1:7447]"),
    ] = None,
    threads: Annotated[int, typer.Option(metavar="N", min=1, max=1024, help="Threads of the linear algebra")] = 1,
    name: Annotated[str, typer.Option(metavar="NAME", help="Name, unique on its server [default: HOST-PID]")] = "",
    server: Annotated[str, typer.Option(metavar="NAME", help="Name of the server")] = "sim",
    no_shared_memory: Annotated[bool, typer.Option("--no-shared-memory", help="Send arrays as bytes")] = False,
    exit_with_parent: Annotated[
        bool, typer.Option("--exit-with-parent", help="End when the parent process ends")
    ] = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="Say more on standard error")] = False,
) -> None:
    """Factorize the matrices of a simulation server, until SIGTERM or Ctrl-C."""
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[variable] = str(threads)
    logging.basicConfig(level=logging.INFO if verbose else logging.WARNING, format="%(name)s: %(message)s")
    signal.signal(signal.SIGTERM, _terminate)
    try:
        if exit_with_parent:
            from precond_worker.parent import end_with_parent

            end_with_parent()
        _serve(connect or [], threads, name or _default_name(), server, not no_shared_memory)
    except KeyboardInterrupt:
        raise typer.Exit(130) from None
    except Terminated:
        raise typer.Exit(0) from None


def _terminate(*_: object) -> None:
    raise Terminated


def _default_name() -> str:
    host = "".join(c if c.isascii() and (c.isalnum() or c in "_.-") else "-" for c in socket.gethostname())
    return f"{host[:50]}-{os.getpid()}"


def _serve(connect: list[str], threads: int, name: str, server: str, shared_memory: bool) -> None:
    from precond_worker.factorize import Analysis, default_library
    from precond_worker.joining import join
    from precond_worker.uplink import Uplink
    from precond_worker.worker import Worker
    from protocol.channels import DEFAULT_ENDPOINT, check_name
    from protocol.counters import Counters
    from protocol.endpoints import BadEndpoint

    try:
        check_name(server, "--server")
        check_name(name, "--name")
        library, remark = default_library()
        if remark:
            print(f"precond-worker: {remark}", file=sys.stderr)
        session = join(connect, shared_memory)
    except (BadEndpoint, ValueError) as error:
        _bad_input(str(error))
    with session, Uplink(session, server, name, threads, library, Counters(logging.getLogger("precond_worker"))) as up:

        def on_server(found: bool) -> None:
            where = f"server {server} at {', '.join(connect or [DEFAULT_ENDPOINT])}"
            if found:
                count = f"{threads} thread{'s' if threads > 1 else ''}"
                memory = "shared memory" if up.shared_memory else "no shared memory"
                print(f"precond-worker {name} ready: {library}, {count}, {memory}, {where}", flush=True)
            else:
                print(f"precond-worker {name}: {where} is gone, waiting for it", file=sys.stderr)

        Worker(up, Analysis, on_server).run()


def _bad_input(text: str) -> NoReturn:
    print(f"precond-worker: {text}", file=sys.stderr)
    raise typer.Exit(2)


def main() -> None:
    """Entry point of the console script."""
    app(prog_name="precond-worker")
