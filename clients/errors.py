# SPDX-License-Identifier: MIT
"""Errors that the command line shows as one line, without a traceback."""


class BadInput(Exception):
    """A file, name or value that the user gave is not usable (exit code 2)."""


class ClientError(Exception):
    """Something else went wrong: no server, a refused command, a viewer that died (exit code 1)."""
