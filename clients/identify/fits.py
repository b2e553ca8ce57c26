# SPDX-License-Identifier: MIT
"""Parameters that are looked for, each between two bounds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from clients.errors import BadInput

DECADE = 10.0  # from this ratio of its bounds on a parameter is looked for on a logarithmic scale
MOST = 20  # parameters


@dataclass(frozen=True)
class Fit:
    """A key as of `--set` with its bounds."""

    key: str
    low: float
    high: float

    @property
    def log(self) -> bool:
        """True if it is looked for on a logarithmic scale."""
        return self.low > 0 and self.high / self.low >= DECADE

    def value(self, share: float) -> float:
        """Returns the value at a share, 0 to 1, of the way from low to high."""
        logarithmic = self.log
        found = self.low * (self.high / self.low) ** share if logarithmic else self.low + share * (self.high - self.low)
        return min(max(found, self.low), self.high)

    def share(self, value: float) -> float:
        """Returns the share of a value."""
        if self.log:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)


def fits(texts: Sequence[str]) -> list[Fit]:
    """Reads KEY=LOW:HIGH. Raises BadInput."""
    found = [_fit(text) for text in texts]
    if not 1 <= len(found) <= MOST:
        raise BadInput(f"--fit: {len(found)} times; allowed 1 to {MOST}")
    keys = [fit.key for fit in found]
    if twice := [key for key in keys if keys.count(key) > 1]:
        raise BadInput(f"--fit {twice[0]}: is given twice")
    return found


def _fit(text: str) -> Fit:
    key, _, bounds = text.partition("=")
    try:
        low, high = (float(word) for word in bounds.split(":"))
    except ValueError:
        example = "object.beam.effects.corotational.young=1e4:1e7"
        raise BadInput(f"--fit {text}: must be KEY=LOW:HIGH, such as {example}") from None
    if not key.strip() or not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise BadInput(f"--fit {text}: needs a key and finite bounds, the lower one first")
    return Fit(key.strip(), low, high)
