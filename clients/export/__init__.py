# SPDX-License-Identifier: MIT
"""A log as files of other programs."""
