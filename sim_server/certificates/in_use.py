# SPDX-License-Identifier: MIT
"""The certificates that a server and what it starts use, and whether others get in without any."""

from pathlib import Path

from protocol.network.endpoints import default_endpoint, on_this_machine
from sim_server.errors import InputError


class Certificates:
    """Of the options --tls, --listen, --connect and --insecure. Raises InputError, BadEndpoint or Refused.

    workers, web: whether the server starts some of its own, which need certificates too

    server: None without --tls
    """

    def __init__(
        self, tls: str | None, listen: list[str] | None, connect: list[str] | None, insecure: bool,
        *, workers: bool, web: bool,
    ):  # fmt: skip
        from protocol.network.exposure import check_exposure
        from protocol.network.identity import SERVER, identity_of

        self.server = None if tls is None else identity_of(tls, (SERVER,))
        if self.server is not None and self.server.role != SERVER:
            raise InputError(f"--tls {tls}: this certificate is that of a {self.server.role}, not of a server")
        if not insecure:
            check_exposure(listen or [], connect or [], self.server is not None)
        self.local_endpoint = on_this_machine((listen or [default_endpoint(self.server is not None)])[0])
        self.for_worker = self._options("worker") if workers else []
        self.for_client = self._options("operator") if web else []

    def _options(self, kind: str) -> list[str]:
        """Returns --tls for a process that this server starts. Raises InputError if there is no certificate for it."""
        if self.server is None:
            return []
        folder: Path = self.server.all_of_them / kind
        if not folder.is_dir():
            raise InputError(f"{folder}: is missing, the certificate of what this server starts with that role")
        return ["--tls", str(folder)]
