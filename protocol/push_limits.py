# SPDX-License-Identifier: MIT
"""Limits of the duration of a push, for server and clients."""

LONGEST_PUSH = 3600.0  # s of simulation
ORPHANED_PUSH = 10.0  # s of simulation after its client is gone
