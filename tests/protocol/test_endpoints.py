# SPDX-License-Identifier: MIT
"""Endpoints as people type them."""

import pytest

from precond_worker.network.server_addresses import ServerAddress, server_addresses
from protocol.channels import DEFAULT_ENDPOINT
from protocol.network.endpoints import CONNECT, BadEndpoint, check_endpoint, on_this_machine, usual_endpoints


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


@pytest.mark.parametrize(
    ("listen", "reached"),
    [
        ("tcp/0.0.0.0:7447", "tcp/127.0.0.1:7447"),
        ("tcp/[::]:7447", "tcp/[::1]:7447"),
        ("tcp/10.0.0.0:7447", "tcp/10.0.0.0:7447"),
        ("unixsock-stream//run/sim.sock", "unixsock-stream//run/sim.sock"),
    ],
)
def test_who_listens_everywhere_is_reached_by_loopback(listen: str, reached: str) -> None:
    assert on_this_machine(listen) == reached


@pytest.mark.parametrize("certified", [True, False])
def test_nobody_listens_by_quic(certified: bool) -> None:
    with pytest.raises(BadEndpoint, match=r"cannot be listened on: one datagram .* allowed: tls/0\.0\.0\.0:7447"):
        check_endpoint("quic/0.0.0.0:7447", listen=True, certified=certified)


def test_any_free_port_may_be_listened_on() -> None:
    assert check_endpoint("tcp/127.0.0.1:0", listen=True)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (None, [DEFAULT_ENDPOINT]),
        ("", [DEFAULT_ENDPOINT]),
        (" , ", [DEFAULT_ENDPOINT]),
        ("tcp/a:1", ["tcp/a:1"]),
        ("tcp/a:1,tcp/b:2", ["tcp/a:1", "tcp/b:2"]),
        (" tcp/a:1  tls/b:2,\tudp/c:3\n", ["tcp/a:1", "tls/b:2", "udp/c:3"]),
    ],
)
def test_endpoints_of_the_environment(text: str | None, expected: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(CONNECT, raising=False)
    if text is not None:
        monkeypatch.setenv(CONNECT, text)
    assert usual_endpoints() == expected
    assert server_addresses(["sim"], []) == [ServerAddress(tuple(expected), ("sim",))]


def test_a_bad_endpoint_of_the_environment_names_the_variable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(CONNECT, "tcp/a:1 nonsense")
    with pytest.raises(BadEndpoint, match="WARPFACTOR_CONNECT: endpoint 'nonsense' cannot be used"):
        usual_endpoints()
