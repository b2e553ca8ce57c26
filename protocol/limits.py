# SPDX-License-Identifier: MIT
"""How long a push may last: what clients must know of it, too."""

LONGEST_PUSH = 3600.0  # s of simulation
ORPHANED_PUSH = 10.0  # s of simulation that a push lasts at most once its client is gone
