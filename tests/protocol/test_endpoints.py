# SPDX-License-Identifier: MIT
"""Endpoints as people type them."""

import pytest

from protocol.endpoints import BadEndpoint, check_endpoint


@pytest.mark.parametrize(
    "endpoint",
    [
        "tcp/127.0.0.1:7447",
        "tcp/[::1]:7447",
        "tls/host.example:443",
        "quic/10.0.0.1:1",
        "unixsock-stream//run/sim.sock",
        "tcp/10.0.0.1:7447#iface=eth0",
    ],
)
def test_good_ones_pass(endpoint: str) -> None:
    assert check_endpoint(endpoint) == endpoint


@pytest.mark.parametrize(
    "endpoint",
    ["", "127.0.0.1:7447", "tcp/127.0.0.1", "http/host:80", "tcp/host:99999", "tcp/host:0", "tcp/:7447", "tcp/"],
)
def test_bad_ones_say_what_is_allowed(endpoint: str) -> None:
    with pytest.raises(BadEndpoint, match="cannot be used; allowed: PROTOCOL/HOST:PORT"):
        check_endpoint(endpoint)


def test_any_free_port_may_be_listened_on() -> None:
    assert check_endpoint("tcp/127.0.0.1:0", listen=True)
