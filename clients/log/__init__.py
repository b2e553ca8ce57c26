# SPDX-License-Identifier: MIT
"""A log as arrays: meshes, frames, scalars per step, stresses."""
