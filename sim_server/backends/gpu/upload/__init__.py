# SPDX-License-Identifier: MIT
"""From factors that came to inverses in the mailboxes of their bodies, as factor_upload.py orders it."""
