# SPDX-License-Identifier: MIT
"""Bodies, their linear system, time integration and energy."""
