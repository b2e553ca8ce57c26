# SPDX-License-Identifier: MIT
"""The start of a server: its options, what it is set up from, and what it says to the terminal."""
