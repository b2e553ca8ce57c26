# SPDX-License-Identifier: MIT
# ruff: noqa: E402 (signal handlers are set before anything else is imported)
"""The command warpfactor: what it is, running, from whatever was installed."""

from protocol.process.early_signals import end_at_once

end_at_once(terminated=143)  # until the demonstration has something to close

import sys
from pathlib import Path
from typing import Annotated

import typer

from clients.errors import BadInput, ClientError
from protocol.process.command_line import Program, end_in_order

PROGRAM = Program("warpfactor")
app = typer.Typer(name="warpfactor", no_args_is_help=True, rich_markup_mode=None, pretty_exceptions_enable=False)


@app.callback()
def warpfactor(version: Annotated[bool, PROGRAM.version_option()] = False) -> None:
    """Real-time simulation of soft bodies; sim-server, precond-worker and sim-client are its programs."""


@app.command()
def demo(
    record: Annotated[Path | None, typer.Option(metavar="FILE.mcap", help="Keep the log (replaces the file)")] = None,
) -> None:
    """Simulate the creature of the gallery for some seconds, push and drag it, and show what happened."""
    from clients.demo.run import run

    end_in_order()
    try:
        run(record)
    except (BadInput, ClientError) as error:
        print(f"warpfactor: {error}", file=sys.stderr)
        raise typer.Exit(2 if isinstance(error, BadInput) else 1) from None
    except KeyboardInterrupt:
        raise typer.Exit(130) from None


def main() -> None:
    """Entry point of the console script."""
    PROGRAM.run(app)
