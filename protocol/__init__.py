# SPDX-License-Identifier: MIT
"""What server, workers and clients agree on: keys, messages, limits, checks and shared memory."""

from protocol.channels import PROTOCOL
from protocol.factor import Factor, FactorPattern
from protocol.refused import Refused

__all__ = ["PROTOCOL", "Factor", "FactorPattern", "Refused"]
