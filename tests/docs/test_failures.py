# SPDX-License-Identifier: MIT
"""The table of what a run does when things go wrong names every status and event, and tests that look at them."""

import re

from protocol import messages_pb2 as pb
from sim_server.service.event_counts import COLUMNS
from tests.docs.figures import DOCS, ROOT, table_under

ROWS = table_under((DOCS / "failures.md").read_text(), "When things go wrong")


def test_every_status_and_event_has_a_row():
    told = {word for row in ROWS for word in re.findall(r"`(\w+)`", row["told by"])}
    statuses = {value.name.lower() for value in pb.SolveStatus.DESCRIPTOR.values}
    assert {*statuses, *COLUMNS} - told == {"converged"}


def test_every_row_says_what_to_do_and_has_tests():
    for row in ROWS:
        assert all(row.values()), row
        named = re.findall(r"`([\w/]+\.py)`", row["tests"])
        assert named and all((ROOT / path).exists() for path in named)
