# SPDX-License-Identifier: MIT
"""Jobs of a server: taken, factorized alone or together, and answered."""
