# SPDX-License-Identifier: MIT
"""Materials by name on a terminal."""
