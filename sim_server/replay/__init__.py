# SPDX-License-Identifier: MIT
"""A recorded run made again and compared with its log."""
