# SPDX-License-Identifier: MIT
"""The command `sim-server certs`: what it makes, what it refuses, and rules for those it made."""

import datetime
import json
import stat
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID
from typer.testing import CliRunner

from protocol.network.identity import SERVER, identity_of, roles_of, usual_identity
from protocol.refused import Refused
from sim_server.certificates.command import USUAL, app

RUNNER = CliRunner()


def certs(*arguments: str) -> str:
    """What the command says; it must succeed."""
    done = RUNNER.invoke(app, arguments)
    assert done.exit_code == 0, done.output
    return done.output


def refused(*arguments: str) -> str:
    done = RUNNER.invoke(app, arguments)
    assert done.exit_code == 2, done.output
    return done.output


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    certs(str(tmp_path / "certs"), "--host", "sim.example.org", "--host", "10.0.0.5", "--client", "alice:participant")
    return tmp_path / "certs"


def certificate(folder: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes())


def test_a_new_folder_has_an_authority_a_server_and_each_role(folder: Path) -> None:
    made = {path.name for path in folder.iterdir()}
    assert made == {"ca.pem", "ca.key", "roles.toml", SERVER, *USUAL, "alice"}
    authority = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
    for name in (SERVER, *USUAL, "alice"):
        found = certificate(folder / name)
        found.verify_directly_issued_by(authority)
        assert found.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value == name
        days = found.not_valid_after_utc - datetime.datetime.now(datetime.UTC)
        assert 364 <= days.days <= 365
        usage = set(found.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value)
        assert (ExtendedKeyUsageOID.SERVER_AUTH in usage) == (name == SERVER), "nobody else can pose as a server"
        assert not found.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    names = certificate(folder / SERVER).extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["sim.example.org", "localhost"]
    assert [str(a) for a in names.get_values_for_type(x509.IPAddress)] == ["10.0.0.5", "127.0.0.1", "::1"]
    identity = identity_of(folder, (SERVER,))
    assert identity.name == SERVER
    assert roles_of(identity) == {**{role: role for role in USUAL}, "alice": "participant"}


def test_keys_are_for_their_owner_alone(folder: Path) -> None:
    keys = [folder / "ca.key", *folder.glob("*/key.pem")]
    assert len(keys) == 7
    assert {stat.S_IMODE(key.stat().st_mode) for key in keys} == {0o600}
    assert {stat.S_IMODE(path.stat().st_mode) for path in [folder, *folder.glob("*/")] if path.is_dir()} == {0o700}


def test_more_are_made_later_and_nothing_is_replaced(folder: Path) -> None:
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != "roles.toml"}
    assert "exists, and is not replaced" in refused(str(folder), "--host", "other")
    assert "exists, and is not replaced" in refused(str(folder))
    assert "alice: exists, and certificates are not replaced" in refused(str(folder), "--client", "alice:operator")
    assert "a name is given twice" in refused(str(folder), "--client", "eve:viewer", "--client", "eve:worker")
    assert certs(str(folder), "--client", "bob:operator") == f"{folder / 'bob'}: operator\n"
    assert {path: path.read_bytes() for path in before} == before
    assert roles_of(identity_of(folder, (SERVER,)))["bob"] == "operator"


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ([], "--host is missing"),
        (["--host", "a", "--client", "bob"], "NAME is ''"),
        (
            ["--host", "a", "--client", "bob:king"],
            "ROLE is 'king'; allowed: viewer, participant, operator, worker, router",
        ),
        (
            ["--host", "a", "--client", "bob.x:viewer"],
            "NAME is 'bob.x'; allowed: 1 to 32 characters of A-Z a-z 0-9 _ -",
        ),
        (["--host", "a", "--client", "../x:viewer"], "allowed: 1 to 32 characters"),
        (["--host", "a", "--client", "server:viewer"], "'server' is the name of servers"),
        (["--host", "a b\0"], "--host"),
    ],
)
def test_what_is_refused_makes_nothing(arguments: list[str], text: str, tmp_path: Path) -> None:
    assert text in refused(str(tmp_path / "certs"), *arguments)
    assert not (tmp_path / "certs" / SERVER).exists()


def test_a_folder_of_other_things_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("x")
    assert "holds other files and no ca.pem" in refused(str(tmp_path), "--host", "a")
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_router_gets_rules_for_the_servers_behind_it(folder: Path) -> None:
    certs(str(folder), "--client", "meeting:router", "--host", "router.example.org")
    rules = json.loads(certs(str(folder), "--rules", "--server", "sim-0", "--server", "sim-1"))["access_control"]
    assert rules["enabled"] and rules["default_permission"] == "deny"
    subjects = {name for subject in rules["subjects"] for name in subject["cert_common_names"]}
    assert subjects == {SERVER, *USUAL, "alice", "meeting"}
    keys = {key for rule in rules["rules"] for key in rule["key_exprs"]}
    assert "warpfactor/sim-0/command/stop/operator.$*" in keys and "warpfactor/sim-1/state/*" in keys
    usage = certificate(folder / "meeting").extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert ExtendedKeyUsageOID.SERVER_AUTH in usage


def test_folders_that_cannot_be_used_are_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(Refused, match=r"no identity.toml there or in viewer/"):
        identity_of(tmp_path, ("viewer",))
    (folder / "viewer" / "key.pem").unlink()
    with pytest.raises(Refused, match=r"viewer/key.pem is not there"):
        identity_of(folder, ("viewer",))
    (folder / "roles.toml").write_text('alice = "king"\n')
    with pytest.raises(Refused, match=r"roles.toml: alice is 'king'; allowed: viewer"):
        roles_of(identity_of(folder, (SERVER,)))
    (folder / "roles.toml").write_text("alice = operator\n")
    with pytest.raises(Refused, match=r"roles.toml: "):
        roles_of(identity_of(folder, (SERVER,)))


def test_the_variable_counts_for_endpoints_with_certificates_alone(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that servers of one's own, on this machine, are still found."""
    monkeypatch.setenv("WARPFACTOR_TLS", str(folder / "alice"))
    for endpoints in ([], ["tls/a:1"], ["tls/a:1", "quic/b:2"]):
        found = usual_identity(None, ("operator",), endpoints)
        assert found is not None and (found.name, found.role) == ("alice", "participant")
    assert usual_identity(None, ("operator",), ["tcp/127.0.0.1:7447"]) is None
    found = usual_identity(folder, ("operator",), ["tcp/127.0.0.1:7447"])
    assert found is not None and found.name == "operator"


def test_the_authority_is_not_made_without_its_key(folder: Path) -> None:
    (folder / "ca.key").unlink()
    assert "ca.key: No such file" in refused(str(folder), "--client", "bob:operator")
    assert not (folder / "bob").exists()
