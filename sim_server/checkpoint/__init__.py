# SPDX-License-Identifier: MIT
"""Checkpoints: what a run needs to go on where it was saved. Start in content.py."""
