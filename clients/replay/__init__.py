# SPDX-License-Identifier: MIT
"""A log replayed: published as if its server were live, or simulated again and compared."""
