# SPDX-License-Identifier: MIT
"""The commands of sim-client: a typer application for each group, which `clients/__main__.py` puts together."""
