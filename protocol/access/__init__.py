# SPDX-License-Identifier: MIT
"""Who may do what: roles of certificates, and names that belong to one client alone."""
