# SPDX-License-Identifier: MIT
"""Workers that factorize the system matrices of a simulation server."""
