# SPDX-License-Identifier: MIT
"""Which endpoints anybody may reach, and which the configuration of zenoh restricts."""

from pathlib import Path

import pytest

from protocol.network.endpoints import BadEndpoint
from protocol.network.exposure import check_exposure, unrestricted
from protocol.network.hosts import beyond_loopback, unknown_hosts
from protocol.network.session import EXTRA_CONFIG

OPEN = ["tcp/0.0.0.0:7447", "tcp/[::]:7447", "udp/192.0.2.7:1", "tls/0.0.0.0:7447"]
CLOSED = ["tcp/127.0.0.1:7447", "tcp/127.1.2.3:7447", "tcp/[::1]:7447", "tcp/localhost:0", "unixsock-stream//run/x"]


@pytest.fixture(autouse=True)
def plain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(EXTRA_CONFIG, raising=False)


def test_what_other_machines_reach() -> None:
    assert [e for e in OPEN + CLOSED if beyond_loopback(e)] == OPEN
    assert unrestricted(OPEN + CLOSED) == OPEN


def test_with_certificates_those_that_ask_for_none_are_left() -> None:
    assert unrestricted(OPEN + CLOSED, certified=True) == OPEN[:3]


@pytest.mark.parametrize("option", ["--listen", "--connect"])
@pytest.mark.parametrize("endpoint", OPEN[:3])
def test_an_open_server_is_refused_and_both_ways_on_are_told(option: str, endpoint: str) -> None:
    """Also one that connects: who reaches the router reaches the server."""
    given = {"listen": [], "connect": [], option.strip("-"): [CLOSED[0], endpoint]}
    for certified in (False, True):
        with pytest.raises(BadEndpoint) as told:
            check_exposure(**given, certified=certified)
        text = str(told.value)
        assert text.startswith(f"{option} {endpoint}: anybody who reaches ")
        assert "`sim-server certs DIR --host NAME`" in text and "--tls DIR" in text and "--insecure" in text
        assert f"{option} tls/{endpoint.partition('/')[2]}" in text
    check_exposure(CLOSED, CLOSED)
    check_exposure(["tls/0.0.0.0:7447"], ["quic/192.0.2.7:1"], certified=True)


def test_names_that_do_not_resolve() -> None:
    endpoints = ["tcp/no-such-host.invalid:1", "tcp/127.0.0.1:1", "unixsock-stream//x"]
    assert unknown_hosts(endpoints) == ["no-such-host.invalid"]


@pytest.mark.parametrize(
    ("config", "left"),
    [
        ("{}", OPEN),
        ("{transport:{link:{tls:{enable_mtls:true}}}}", OPEN),
        ("{transport:{link:{tls:{enable_mtls:false}}}}", OPEN),
        ('{access_control:{enabled:true,default_permission:"deny"}}', OPEN),
        (
            '{access_control:{enabled:true,default_permission:"deny"},transport:{link:{tls:{enable_mtls:true}}}}',
            OPEN[:3],
        ),
        ('{access_control:{enabled:false,default_permission:"deny"}}', OPEN),
        ('{transport:{auth:{usrpwd:{user:"s",password:"p",dictionary_file:"users.txt"}}}}', OPEN),
    ],
)
def test_what_the_configuration_restricts(
    config: str, left: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "zenoh.json5"
    path.write_text(config)
    monkeypatch.setenv(EXTRA_CONFIG, str(path))
    assert unrestricted(OPEN + CLOSED) == left
