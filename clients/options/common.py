# SPDX-License-Identifier: MIT
"""Options and arguments that several commands of sim-client have."""

from __future__ import annotations

from typing import Annotated

import typer

from clients.options.point import AT_HELP
from protocol.channels import DEFAULT_ENDPOINT
from protocol.network.endpoints import CONNECT

Triple = tuple[float, float, float]
Connect = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ENDPOINT",
        help=f"Where the server listens; may be repeated. By default {CONNECT} (separated by commas or spaces) "
        f"or {DEFAULT_ENDPOINT}.",
    ),
]
Elsewhere = Annotated[
    list[str] | None, typer.Option(metavar="ENDPOINT", help="Of a server or router that runs; may be repeated.")
]
Server = Annotated[str, typer.Option(metavar="NAME", help="Name of the server.")]
Object = Annotated[str, typer.Option("--object", metavar="NAME", help="Object of the scene.")]
At = Annotated[str, typer.Option("--at", metavar="POINT", help=AT_HELP)]
Json = Annotated[bool, typer.Option("--json", help="For programs.")]
