# SPDX-License-Identifier: MIT
"""The step on an NVIDIA GPU: the same kernel texts, one CUDA graph per step, a persistent conjugate gradient solver."""
