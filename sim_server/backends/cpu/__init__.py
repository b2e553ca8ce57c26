# SPDX-License-Identifier: MIT
"""Steps on the processor."""
