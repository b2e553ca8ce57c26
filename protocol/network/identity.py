# SPDX-License-Identifier: MIT
"""Folders that `sim-server certs` makes: certificate, key and authority of one process, and who has which role.

DIR/roles.toml                   name of each certificate and its role; read by the server when it starts
DIR/NAME/ca.pem, cert.pem, key.pem, identity.toml
"""

import os
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from protocol.access.roles import check_identity, check_roles
from protocol.network.endpoints import CERTIFIED
from protocol.refused import Refused

TLS = "WARPFACTOR_TLS"  # folder of workers and clients, where none is given on the command line
AUTHORITY, CERTIFICATE, KEY, OWN, ROLES_FILE = "ca.pem", "cert.pem", "key.pem", "identity.toml", "roles.toml"
SERVER = "server"  # name of the certificate of servers


@dataclass(frozen=True)
class Identity:
    """name: the common name of the certificate. role: what it was made for. folder: of the files."""

    name: str
    role: str
    folder: Path

    def file(self, name: str) -> str:
        """Returns the path of one of its files."""
        return str(self.folder / name)

    @property
    def all_of_them(self) -> Path:
        """The folder that holds the folders of all certificates, where the server finds the roles."""
        return self.folder.parent


def usual_identity(folder: str | Path | None, kinds: Sequence[str], endpoints: Sequence[str]) -> Identity | None:
    """Returns the identity in `folder`, else in that of WARPFACTOR_TLS, which counts for endpoints with TLS alone.

    endpoints: to connect to; none: the default one. As `identity_of` otherwise.
    """
    if folder is None and all(endpoint.partition("/")[0] in CERTIFIED for endpoint in endpoints):
        folder = os.environ.get(TLS) or None
    return None if folder is None else identity_of(folder, kinds)


def identity_of(folder: str | Path, kinds: Sequence[str]) -> Identity:
    """Returns the identity in `folder`. kinds: names that are looked for in a folder with several.

    Raises Refused, which names the file.
    """
    there = Path(folder).expanduser().absolute()
    found = next((path for path in (there, *(there / kind for kind in kinds)) if (path / OWN).is_file()), None)
    if found is None:
        raise Refused(
            f"--tls {folder}: no {OWN} there or in {', '.join(f'{kind}/' for kind in kinds)}; `sim-server certs DIR "
            "--host NAME` makes such folders",
            "malformed",
        )
    for name in (AUTHORITY, CERTIFICATE, KEY):
        if not os.access(found / name, os.R_OK):
            raise Refused(f"--tls {folder}: {found / name} is not there, or may not be read", "malformed")
    told = _toml(found / OWN)
    name = check_identity(str(told.get("name", "")), f"{found / OWN}: name")
    return Identity(name, str(told.get("role", "")), found)


def roles_of(server: Identity) -> dict[str, str]:
    """Returns the role of each certificate, as the server has them beside its own folder. Raises Refused."""
    path = server.all_of_them / ROLES_FILE
    return check_roles(_toml(path), str(path))


def _toml(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text())
    except OSError as error:
        raise Refused(f"{path}: {error.strerror}", "malformed") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise Refused(f"{path}: {error}", "malformed") from None
