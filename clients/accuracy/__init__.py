# SPDX-License-Identifier: MIT
"""What accuracy costs in time: runs a scene at many settings and compares each run with a reference."""
