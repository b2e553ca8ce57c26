# SPDX-License-Identifier: MIT
"""What the programs have in common as processes: signals, exit codes, versions, exhausted resources."""
