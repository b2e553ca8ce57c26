# SPDX-License-Identifier: MIT
"""Proposes settings of a scene from measured points: the most exact ones for a time, or the cheapest for an error."""
