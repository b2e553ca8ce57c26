# SPDX-License-Identifier: MIT
"""Force feedback at the rate of a device: a virtual coupling, its loop, and how late forces come."""
