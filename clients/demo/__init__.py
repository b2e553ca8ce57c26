# SPDX-License-Identifier: MIT
"""Runs a scene that comes along, with a worker and a client, and tells what happened."""
