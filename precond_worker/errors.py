# SPDX-License-Identifier: MIT
"""Why a matrix has no factor."""


class NotPositiveDefinite(ValueError):
    """The matrix has no Cholesky factor in the precision asked for.

    column: first column of L whose pivot failed, -1 if that is not known.
    """

    def __init__(self, text: str, column: int = -1):
        super().__init__(text)
        self.column = column


class OutOfRange(NotPositiveDefinite):
    """There is a factor, but its numbers do not fit into the precision asked for."""


class NameTaken(RuntimeError):
    """Another worker of this name serves the server."""


class DeviceUnusable(RuntimeError):
    """There is no GPU to work on, and why."""
