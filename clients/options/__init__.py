# SPDX-License-Identifier: MIT
"""Options of sim-client that several commands share."""
