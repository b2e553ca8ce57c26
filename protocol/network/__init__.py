# SPDX-License-Identifier: MIT
"""Zenoh sessions and the endpoints they connect to or listen on."""
