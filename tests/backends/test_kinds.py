# SPDX-License-Identifier: MIT
"""Kinds of preconditioners and ways for a solve to end have the same numbers in C++, in Python and on the wire."""

from protocol import messages_pb2 as pb
from sim_server.backends.energies import CODES
from sim_server.backends.kinds import KINDS, Kind


def test_python_knows_every_preconditioner_of_the_loops():
    assert {kind.name: kind.value for kind in Kind} == KINDS.enumeration("Kind")


def test_a_status_is_the_same_number_in_records_and_messages():
    assert KINDS.enumeration("Status") == dict(pb.SolveStatus.items())


def test_every_answer_to_a_runaway_has_a_number_of_its_own():
    told = {name: number for name, number in CODES.items() if name != "halve"}
    assert len(set(told.values())) == len(told) == 3 and CODES["halve"] == CODES["freeze"]
