# SPDX-License-Identifier: MIT
"""The command line of `sim-server certs`. A program of its own beside `sim-server SCENE.toml`, whose form is kept."""

import json
from pathlib import Path
from typing import Annotated

import typer

from protocol.process.command_line import Program
from protocol.refused import Refused
from sim_server.errors import InputError

PROGRAM = Program("sim-server certs")
app = typer.Typer(pretty_exceptions_enable=False, rich_markup_mode=None)
USUAL = ("viewer", "participant", "operator", "worker")  # certificates that a new folder gets, each of its role

EPILOG = """\b
Examples:
  sim-server certs certs --host sim.example.org
        an authority, a certificate for the server, and one for each role
  sim-server certs certs --client alice:participant --client bob:operator
        later: certificates for two persons
  sim-server certs certs --rules --server sim-0 --server sim-1
        the access rules for a router, as sim-server --tls certs has them
"""


@app.command(epilog=EPILOG)
def certs(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Of the authority and all it makes")],
    host: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="By which the server is reached, or its address")
    ] = None,
    client: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME:ROLE", help="A certificate more; viewer, participant, operator, worker or router"),
    ] = None,
    days: Annotated[int, typer.Option(metavar="N", min=1, max=3650, help="That certificates are valid")] = 365,
    rules: Annotated[
        bool, typer.Option("--rules", help="Print access rules for the configuration of a router, and end")
    ] = False,
    server: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Of --rules: names of servers [default: sim]")
    ] = None,
) -> None:
    """Make certificates for a server, its workers and clients, for --tls of all three.

    Nothing that exists is replaced. DIR/ca.key makes further certificates: whoever has it gets in as anybody.
    """
    try:
        if rules:
            _print_rules(folder, server or ["sim"])
            return
        made = _make(folder, host or [], [_split(each) for each in client or []], days)
    except (InputError, Refused) as error:
        PROGRAM.bad_input(str(error))
    for path, role in made.items():
        print(f"{path}: {role}")


def _split(text: str) -> tuple[str, str]:
    """Returns name and role of NAME:ROLE. Raises Refused."""
    from protocol.access.roles import check_identity, check_role
    from protocol.network.identity import SERVER

    name, _, role = text.rpartition(":")
    if check_identity(name, f"--client {text}: NAME") == SERVER:
        raise Refused(f"--client {text}: {SERVER!r} is the name of servers")
    return name, check_role(role, f"--client {text}: ROLE")


def _make(folder: Path, hosts: list[str], clients: list[tuple[str, str]], days: int) -> dict[Path, str]:
    """Makes what is asked for; returns the folders and what each is for. Raises InputError."""
    from protocol.network.identity import SERVER
    from sim_server.certificates.authority import Authority

    new = not (folder / SERVER).exists()
    if new and not hosts:
        raise InputError("--host is missing: the name or address by which workers and clients reach the server")
    if not new and not clients:
        raise InputError(f"{folder / SERVER}: exists, and is not replaced; --client NAME:ROLE makes certificates more")
    if not new and hosts and all(role != "router" for _, role in clients):
        raise InputError(f"--host: {folder / SERVER} exists, and is not replaced; remove it first")
    roles = dict(clients)
    if len(roles) < len(clients):
        raise InputError("--client: a name is given twice")
    first = not (folder / "ca.pem").exists()
    if first:
        roles = {name: name for name in USUAL} | roles
    if taken := [name for name in roles if (folder / name).exists()]:
        raise InputError(f"{folder / taken[0]}: exists, and certificates are not replaced; remove it first")
    authority = Authority(folder)
    made = {authority.make_server(hosts, days): "server"} if new else {}
    made |= {authority.make(name, role, days, hosts): role for name, role in roles.items()}
    authority.add_roles(roles)
    return made


def _print_rules(folder: Path, servers: list[str]) -> None:
    """Prints `access_control` and the settings of TLS as zenohd takes them."""
    from protocol.channels import check_name
    from protocol.network.access_rules import access_rules
    from protocol.network.identity import SERVER, identity_of, roles_of

    identity = identity_of(folder, (SERVER,))
    print(
        json.dumps(
            {"access_control": access_rules([check_name(s, "--server") for s in servers], roles_of(identity))}, indent=1
        )
    )
