# SPDX-License-Identifier: MIT
"""When factors are made, of which matrix, and which of them are used."""
