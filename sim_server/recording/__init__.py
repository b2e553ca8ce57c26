# SPDX-License-Identifier: MIT
"""Logs of a run, and what a replay of it needs."""
