# SPDX-License-Identifier: MIT
"""Errors of factorizations and of the worker."""


class NotPositiveDefinite(ValueError):
    """The matrix has no Cholesky factor in the requested precision.

    column: first column of L whose pivot failed, -1 if unknown.
    """

    def __init__(self, text: str, column: int = -1):
        super().__init__(text)
        self.column = column


class OutOfRange(NotPositiveDefinite):
    """The factor exists, but its numbers are out of the range of the requested type."""


class NameTaken(RuntimeError):
    """Another worker of this name serves the server. server: its name"""

    def __init__(self, text: str, server: str):
        super().__init__(text)
        self.server = server


class DeviceUnusable(RuntimeError):
    """No GPU can be used; the text says why."""
