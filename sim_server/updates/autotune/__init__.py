# SPDX-License-Identifier: MIT
"""preconditioner = "auto": block Jacobi or a factor, and which factor, by measured costs of solves."""
