# SPDX-License-Identifier: MIT
"""The worker's side of the network: addresses, connections, which server lives, heartbeats."""
