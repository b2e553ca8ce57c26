# SPDX-License-Identifier: MIT
"""Makes the folders of certificates that protocol/network/identity.py reads. Keys are elliptic (P-256).

A certificate of a client or worker cannot be that of a server: its extended key usage says what it is for.
"""

import datetime
import ipaddress
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from protocol.network.identity import AUTHORITY, CERTIFICATE, KEY, OWN, ROLES_FILE, SERVER
from sim_server.errors import InputError

AUTHORITY_KEY = "ca.key"
AUTHORITY_DAYS = 3650
SKEW = datetime.timedelta(hours=1)  # that clocks of other machines may be behind
LOCAL = ("localhost", "127.0.0.1", "::1")  # by which workers of the same machine call a server

PrivateKey = ec.EllipticCurvePrivateKey


class Authority:
    """The authority in `folder`, made there if there is none. Raises InputError."""

    def __init__(self, folder: Path):
        self.folder = folder
        try:
            if (folder / AUTHORITY).exists():
                self._certificate = x509.load_pem_x509_certificate((folder / AUTHORITY).read_bytes())
                loaded = serialization.load_pem_private_key((folder / AUTHORITY_KEY).read_bytes(), None)
                if not isinstance(loaded, PrivateKey):
                    raise InputError(f"{folder / AUTHORITY_KEY}: no elliptic key, so not one of `sim-server certs`")
                self._key: PrivateKey = loaded
            else:
                self._make()
        except OSError as error:
            raise InputError(f"{error.filename}: {error.strerror}") from None
        except ValueError as error:
            raise InputError(f"{folder}: the authority there cannot be read: {error}") from None

    def _make(self) -> None:
        if self.folder.exists() and any(self.folder.iterdir()):
            raise InputError(f"{self.folder}: holds other files and no {AUTHORITY}; name a folder that is new or empty")
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._key = _new_key()
        name = _name(f"warpfactor {self.folder.absolute().name}")
        usage = x509.KeyUsage(
            digital_signature=False, content_commitment=False, key_encipherment=False, data_encipherment=False,
            key_agreement=False, key_cert_sign=True, crl_sign=True, encipher_only=False, decipher_only=False,
        )  # fmt: skip
        builder = _builder(name, name, self._key.public_key(), AUTHORITY_DAYS)
        builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        builder = builder.add_extension(usage, critical=True)
        self._certificate = builder.sign(self._key, hashes.SHA256())
        _write(self.folder / AUTHORITY_KEY, _pem_of(self._key), 0o600)
        _write(self.folder / AUTHORITY, self._pem(self._certificate), 0o644)

    def make_server(self, hosts: Sequence[str], days: int) -> Path:
        """Makes the certificate of servers that are reached by these names or addresses. Raises InputError."""
        names = dict.fromkeys(_general_name(host) for host in (*hosts, *LOCAL))
        usage = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]  # the latter at a router
        return self._write_folder(SERVER, SERVER, usage, days, x509.SubjectAlternativeName(names))

    def make(self, name: str, role: str, days: int, hosts: Sequence[str] = ()) -> Path:
        """Makes the certificate of a client or worker, or with the role router of one that is reached by `hosts`."""
        usage, names = [ExtendedKeyUsageOID.CLIENT_AUTH], None
        if role == "router":
            usage.append(ExtendedKeyUsageOID.SERVER_AUTH)
            names = x509.SubjectAlternativeName(dict.fromkeys(_general_name(host) for host in (*hosts, *LOCAL)))
        return self._write_folder(name, role, usage, days, names)

    def _write_folder(
        self, name: str, role: str, usage: list[x509.ObjectIdentifier], days: int,
        names: x509.SubjectAlternativeName | None,
    ) -> Path:  # fmt: skip
        folder, key = self.folder / name, _new_key()
        builder = _builder(_name(name), self._certificate.subject, key.public_key(), days)
        builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        builder = builder.add_extension(x509.ExtendedKeyUsage(usage), critical=False)
        signer = x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key())
        builder = builder.add_extension(signer, critical=False)
        if names is not None:
            builder = builder.add_extension(names, critical=False)
        try:
            folder.mkdir(mode=0o700)
        except FileExistsError:
            raise InputError(f"{folder}: exists, and certificates are not replaced; remove it first") from None
        _write(folder / KEY, _pem_of(key), 0o600)
        _write(folder / CERTIFICATE, self._pem(builder.sign(self._key, hashes.SHA256())), 0o644)
        _write(folder / AUTHORITY, self._pem(self._certificate), 0o644)
        _write(folder / OWN, f'name = "{name}"\nrole = "{role}"\n'.encode(), 0o644)
        return folder

    def add_roles(self, roles: Mapping[str, str]) -> None:
        """Notes who may do what, for servers that start from now on."""
        path = self.folder / ROLES_FILE
        if not path.exists():
            _write(path, b"# Certificate and role. Who is not here has no access; read when a server starts.\n", 0o644)
        with path.open("a") as file:
            file.writelines(f'{name} = "{role}"\n' for name, role in roles.items())

    @staticmethod
    def _pem(certificate: x509.Certificate) -> bytes:
        return certificate.public_bytes(serialization.Encoding.PEM)


def _new_key() -> PrivateKey:
    return ec.generate_private_key(ec.SECP256R1())


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common[:64])])


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host.strip("[]")))
    except ValueError:
        pass
    if not all(re.fullmatch(r"[A-Za-z0-9_-]{1,63}", label) for label in host.split(".")):
        raise InputError(f"--host {host[:80]!r}: allowed is the name of a host or an address, without port")
    return x509.DNSName(host)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, days: int
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    builder = x509.CertificateBuilder(issuer, subject, key, x509.random_serial_number())
    builder = builder.not_valid_before(now - SKEW).not_valid_after(now + datetime.timedelta(days=days))
    return builder.add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)


def _pem_of(key: PrivateKey) -> bytes:
    plain = serialization.NoEncryption()
    return key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, plain)


def _write(path: Path, data: bytes, mode: int) -> None:
    """Writes a new file, with its mode from the first moment on; raises InputError if it exists."""
    try:
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(data)
    except FileExistsError:
        raise InputError(f"{path}: exists, and is not replaced") from None
