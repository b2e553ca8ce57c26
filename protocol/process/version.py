# SPDX-License-Identifier: MIT
"""Which version runs."""

from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as of_package


def version() -> str:
    """Of the package as installed; said so where it runs from its files alone."""
    try:
        return of_package("warpfactor")
    except PackageNotFoundError:
        return "(not installed)"
