# SPDX-License-Identifier: MIT
"""A run as an image: in the rerun viewer, as a file of it, as a picture."""
