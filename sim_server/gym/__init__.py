# SPDX-License-Identifier: MIT
"""Environments of gymnasium: copies of a scene's objects, all stepped at once. It needs the extra gym."""

import gymnasium  # noqa: F401  before all else, so that who lacks it is told of it

from sim_server.gym.actions import Forces, Grabs
from sim_server.gym.environment import State, VectorEnv

__all__ = ["Forces", "Grabs", "State", "VectorEnv"]
