# SPDX-License-Identifier: MIT
"""The server on the network: link.py (session, published messages, commands) and dispatch.py (jobs and factors)."""
