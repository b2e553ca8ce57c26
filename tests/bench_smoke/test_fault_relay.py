# SPDX-License-Identifier: MIT
"""What the cable of the faults does to packets: nothing, losing all, or keeping them for a while."""

import os
import socket

import pytest

from tests.bench.faults.net import FAR, Cable, Unavailable, command
from tests.bench.faults.relay import BACKLOG, Way


@pytest.fixture
def way():
    """A direction, the end that sends and the end that gets."""
    ends = [
        *socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM),
        *socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM),
    ]
    for end in ends:
        end.setblocking(False)
    yield Way(ends[1].fileno(), ends[2].fileno()), ends[0], ends[3]
    for end in ends:
        end.close()


def arrived(end: socket.socket) -> list[bytes]:
    found = []
    while True:
        try:
            found.append(end.recv(1 << 16))
        except BlockingIOError:
            return found


def test_packets_pass_in_order(way):
    way, near, far = way
    for k in range(5):
        near.send(bytes([k]) * 10)
    way.take(False, 0.0)
    assert way.give() is None
    assert arrived(far) == [bytes([k]) * 10 for k in range(5)]


def test_a_cut_cable_passes_nothing(way):
    way, near, far = way
    for is_cut, count in ((True, 0), (False, 10)):
        for _ in range(10):
            near.send(b"x")
        way.take(is_cut, 0.0)
        way.give()
        assert len(arrived(far)) == count


def test_a_slow_cable_keeps_what_fits_and_drops_the_rest(way):
    way, near, _ = way
    rate = 1000 / BACKLOG  # bytes/s: ten packets of 100 bytes may wait
    for _ in range(8):
        for _ in range(4):
            near.send(bytes(100))
        way.take(False, rate / 1e3)
    assert 1 <= len(way.under_way) <= 2


@pytest.mark.system
def test_a_namespace_at_the_end_of_a_cable():
    """Where root may make one."""
    try:
        with Cable() as cable:
            for is_cut in (True, False):
                cable.cut(is_cut)
                command(*cable.far, "ip", "link", "show", FAR)
    except Unavailable as why:
        assert os.geteuid() or str(why)
        pytest.skip(str(why))
    with pytest.raises(Unavailable):
        command("ip", "netns", "exec", FAR, "true")
