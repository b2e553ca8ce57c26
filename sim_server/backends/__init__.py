# SPDX-License-Identifier: MIT
"""Where steps run: on the processor's cores or on a GPU."""
