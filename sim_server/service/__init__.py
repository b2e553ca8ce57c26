# SPDX-License-Identifier: MIT
"""The server around a simulation: commands, telemetry, workers of its own."""
