# SPDX-License-Identifier: MIT
"""Arrays that server and workers on one host exchange by reference."""
