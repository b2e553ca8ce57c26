# SPDX-License-Identifier: MIT
"""One line of the table of `bench verification`."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Row:
    """reference, ours: values; error: what `kind` says; most: above it the line does not hold."""

    case: str
    reference: float
    ours: float
    error: float
    most: float
    source: str
    kind: str = "relative"

    @property
    def holds(self) -> bool:
        """Also False for NaN."""
        return bool(self.error <= self.most)

    def cells(self) -> dict[str, Any]:
        """For the table."""
        return {
            "case": self.case, "reference": f"{self.reference:.6g}", "ours": f"{self.ours:.6g}",
            "error": f"{self.error:.1e}", "of": self.kind if self.reference else "absolute",
            "at most": f"{self.most:g}",
            "holds": "yes" if self.holds else "**no**", "source of the reference": self.source,
        }  # fmt: skip


def relative(case: str, reference: float, ours: float, most: float, source: str) -> Row:
    """Error of the value."""
    return Row(case, reference, float(ours), abs(float(ours) / reference - 1), most, source)


def absolute(case: str, reference: float, ours: float, most: float, source: str) -> Row:
    """Difference to the reference."""
    return Row(case, reference, float(ours), abs(float(ours) - reference), most, source, "absolute")
