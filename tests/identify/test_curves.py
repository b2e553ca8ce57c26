# SPDX-License-Identifier: MIT
"""Measured curves: what is read, and what is refused by file, column and line."""

from pathlib import Path

import numpy as np
import pytest

from clients.errors import BadInput
from clients.identify.curves import read

GOOD = "time,beam[12].y,beam[0.1 0 -2e-3].x,beam/clamp.fz\n0,0,0,\n0.5,-1e-3,,4\n\n1,-2e-3,1e-3,5\n"


def written(folder: Path, text: str) -> Path:
    path = folder / "tip.csv"
    path.write_text(text)
    return path


def test_columns_and_gaps_are_read(tmp_path: Path) -> None:
    found = read(written(tmp_path, "\ufeff" + GOOD))
    assert [(c.object, c.axis, c.node, c.what) for c in found.columns] == [
        ("beam", 1, (12.0,), ""), ("beam", 0, (0.1, 0.0, -2e-3), ""), ("beam", 2, (), "clamp"),
    ]  # fmt: skip
    np.testing.assert_array_equal(found.times, [0, 0.5, 1])
    np.testing.assert_array_equal(np.isnan(found.values).sum(axis=0), [0, 1, 1])
    assert found.duration == 1


def test_the_misfit_is_relative_to_the_largest_value_of_each_column(tmp_path: Path) -> None:
    """All columns off by a tenth of theirs: 0.1, whatever their units and gaps."""
    found = read(written(tmp_path, GOOD))
    simulated = np.nan_to_num(found.values) + 0.1 * np.nanmax(np.abs(found.values), axis=0)
    assert np.linalg.norm(found.residual(simulated)) == pytest.approx(0.1)
    assert len(found.residual(simulated)) == 7


BAD = [
    ("", "tip.csv, column 1, line 1: '': must be time"),
    ("t,a[1].x\n1,1\n", "column 1, line 1: 't': must be time"),
    ("time\n1\n", "line 1: needs 1 to 999 columns beside time"),
    ("time,a[1].x,a[1].x\n1,1,1\n", r"column 'a\[1\].x', line 1: is there twice"),
    ("time,a.x\n1,1\n", r"column 'a.x', line 1: allowed are time, OBJECT\[NODE\].x"),
    ("time,a[1 2].x\n1,1\n", r"column 'a\[1 2\].x', line 1: allowed are"),
    ("time,a[-1].x\n1,1\n", r"column 'a\[-1\].x', line 1: allowed are"),
    ("time,a[1].x\n1\n", "line 2: 1 cells; line 1 has 2 columns"),
    ("time,a[1].x\n0,1\n1,one\n", r"column 'a\[1\].x', line 3: 'one': must be a finite number"),
    ("time,a[1].x\n0,1\n1,nan\n", r"column 'a\[1\].x', line 3: 'nan': must be a finite number"),
    ("time,a[1].x\n-1,1\n", "column 'time', line 2: '-1': must be a finite number from 0 on"),
    ("time,a[1].x\n,1\n", "column 'time', line 2: '': must be a finite number from 0 on"),
    ("time,a[1].x\n1,1\n\n1,2\n", "column 'time', line 4: 1 after 1: times must rise"),
    ("time,a[1].x\n", "needs a line with a time above 0 s"),
    ("time,a[1].x\n0,1\n", "needs a line with a time above 0 s"),
    ("time,a[1].x\n0,0\n1,\n", r"column 'a\[1\].x': needs a number other than 0"),
]


@pytest.mark.parametrize(("text", "message"), BAD, ids=[m for _, m in BAD])
def test_bad_files_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(BadInput, match=message):
        read(written(tmp_path, text))


def test_files_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"none.csv: cannot be read: No such file"):
        read(tmp_path / "none.csv")
    (tmp_path / "tip.csv").write_bytes(b"time,a[1].x\n\xff\xfe,1\n")
    with pytest.raises(BadInput, match=r"tip.csv: cannot be read: "):
        read(tmp_path / "tip.csv")
