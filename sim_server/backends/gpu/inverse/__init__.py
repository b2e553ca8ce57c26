# SPDX-License-Identifier: MIT
"""The partitioned inverse of a factor on a GPU."""
