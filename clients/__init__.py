# SPDX-License-Identifier: MIT
"""What users run against a server or a log: the command line, the library behind it, viewer and export."""
