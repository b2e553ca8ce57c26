# SPDX-License-Identifier: MIT
"""What stands beside the bodies on the page: curves, tables, sliders, buttons."""
