# SPDX-License-Identifier: MIT
"""A factor as a partitioned inverse on a GPU."""
