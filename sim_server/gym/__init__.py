# SPDX-License-Identifier: MIT
"""Environments of gymnasium: copies of a scene's objects, all stepped at once. It needs the extra gym."""

from gymnasium.vector import AutoresetMode

from sim_server.gym.actions import Forces, Grabs
from sim_server.gym.environment import State, VectorEnv

__all__ = ["AutoresetMode", "Forces", "Grabs", "State", "VectorEnv"]
