# SPDX-License-Identifier: MIT
"""Repeats a recorded run and compares it with its log."""
