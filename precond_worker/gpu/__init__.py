# SPDX-License-Identifier: MIT
"""Cholesky factors on an NVIDIA GPU: a multifrontal method over the same elimination tree as on the CPU."""
