# SPDX-License-Identifier: MIT
# ruff: noqa: E402 (signal handlers are set before anything else is imported)
"""The command sim-client."""

from __future__ import annotations

from protocol.process.early_signals import end_at_once

end_at_once(terminated=143)  # until main() sets its own handlers

import signal
import sys
from typing import Annotated

import typer

from clients.commands import act, control, logs, observe, parameters, show, studies
from clients.errors import BadInput, ClientError
from clients.options.tls import TlsGroup
from protocol.printable import printable
from protocol.process.command_line import Program, handle, leave
from protocol.process.exhausted import exhausted
from protocol.process.extras import missing_extra

PROGRAM = Program("sim-client")
app = typer.Typer(
    name="sim-client",
    cls=TlsGroup,
    help="Look at a running sim-server, push its bodies about, view and export its logs.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
for group in (observe, act, parameters, control, show, logs, studies):  # as --help lists them
    app.add_typer(group.app)


@app.callback()
def client(
    version: Annotated[bool, PROGRAM.version_option()] = False,
) -> None:
    """Look at a running sim-server, push its bodies about, view and export its logs."""


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
