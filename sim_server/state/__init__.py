# SPDX-License-Identifier: MIT
"""What one step leaves to the next (arrays.py), from which resets and checkpoints are made."""
