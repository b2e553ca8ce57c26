# SPDX-License-Identifier: MIT
"""Types of arrays, and of what returns them."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Float64 = NDArray[np.float64]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]

Together = Callable[[], NDArray[np.floating] | None]
"""Waits for factors that are made together, (k, values); None if one of them has none."""
