# SPDX-License-Identifier: MIT
"""The symbolic phase on the CPU: fill-reducing order, elimination tree and supernodes of a block pattern."""
