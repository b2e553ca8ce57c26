# SPDX-License-Identifier: MIT
"""What server, workers and clients agree on: keys, messages, limits, checks and shared memory.

Nothing is imported here: a program that begins may set its signal handlers first (process/early_signals.py).
"""
