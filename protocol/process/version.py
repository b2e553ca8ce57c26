# SPDX-License-Identifier: MIT
"""Which version runs."""

from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as of_package


def version() -> str:
    """Returns the version of the installed package, or says that it runs from its files alone."""
    try:
        return of_package("warpfactor")
    except PackageNotFoundError:
        return "(not installed)"
