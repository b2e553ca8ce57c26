# SPDX-License-Identifier: MIT
"""The option --tls of all commands that connect to a server: stands for WARPFACTOR_TLS, also in what they start."""

from __future__ import annotations

import os
from functools import partial
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from clients.errors import BadInput
from protocol.network.endpoints import BadEndpoint, check_endpoint, usual_endpoints
from protocol.network.identity import TLS

HELP = f"Folder of a certificate, as sim-server certs makes it. By default {TLS}, else none."


class TlsGroup(TyperGroup):
    """A group whose commands have --tls DIR if they have --connect and --server."""

    def __init__(self, **attributes: Any):
        super().__init__(**attributes)
        for command in self.commands.values():
            if {"connect", "server"} <= {parameter.name for parameter in command.params}:
                command.params.append(_option())
                command.invoke = partial(_invoke, command.invoke)  # type: ignore[method-assign]


def _option() -> Any:
    """Returns the option as typer makes it."""
    app = typer.Typer()

    @app.command()
    def any_command(tls: Annotated[str | None, typer.Option("--tls", metavar="DIR", help=HELP)] = None) -> None:
        pass

    return next(p for p in typer.main.get_command(app).params if p.name == "tls")


def _invoke(command: Any, context: Any) -> Any:
    folder = context.params.pop("tls", None)
    if folder is not None:
        try:
            for endpoint in context.params.get("connect") or usual_endpoints(certified=True):
                check_endpoint(endpoint, certified=True)
        except BadEndpoint as error:
            raise BadInput(str(error)) from None
        os.environ[TLS] = folder
    return command(context)
