# SPDX-License-Identifier: MIT
"""`sim-client load`: a server under many bodies and clients, and a report of its steps."""
