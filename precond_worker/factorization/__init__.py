# SPDX-License-Identifier: MIT
"""Factors of system matrices: complete and incomplete Cholesky, SSOR."""
