# SPDX-License-Identifier: MIT
"""The server on the network: jobs for workers, their answers, what is published, what clients ask. Face: link.py."""
