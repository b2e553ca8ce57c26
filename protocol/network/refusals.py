# SPDX-License-Identifier: MIT
"""Says why two sides do not accept each other: zenoh reports a refused handshake as one that takes too long.

So the handshake is made once more, by Python's ssl, which tells what either side has against the certificate of the
other. Nothing is sent behind it.
"""

import socket
import ssl
from collections.abc import Sequence

from protocol.network.endpoints import CERTIFIED, host_of, port_of
from protocol.network.identity import AUTHORITY, CERTIFICATE, KEY, Identity

TIMEOUT = 1.0  # s of the connection, and of the other side's last word
ALERTS = {  # what the other side says of our certificate, by a part of OpenSSL's name of its alert
    "CERTIFICATE_REQUIRED": "it asks for a certificate: --tls DIR names the folder of one",
    "UNKNOWN_CA": "it does not know the authority that signed this certificate",
    "CERTIFICATE_EXPIRED": "this certificate has expired",
    "CERTIFICATE_REVOKED": "this certificate was revoked",
    "BAD_CERTIFICATE": "it does not accept this certificate",
    "UNSUPPORTED_CERTIFICATE": "it does not accept this certificate for a client",
    "CERTIFICATE_UNKNOWN": "it does not accept this certificate",
    "DECRYPT_ERROR": "this key does not belong to this certificate",
    "HANDSHAKE_FAILURE": "it asks for a certificate: --tls DIR names the folder of one",
}
VERIFY = {  # what we say of its certificate, by the codes of OpenSSL
    9: "its certificate is not valid yet: is the clock right?",
    10: "its certificate has expired",
    18: "its certificate is not signed by the authority of {folder}",
    19: "its certificate is not signed by the authority of {folder}",
    20: "its certificate is not signed by the authority of {folder}",
    26: "its certificate is not that of a server",
    62: "its certificate is not for {host}; `sim-server certs DIR --host {host}` makes one that is",
    64: "its certificate is not for {host}; `sim-server certs DIR --host {host}` makes one that is",
}


def why_refused(endpoints: Sequence[str], tls: Identity | None) -> str:
    """Returns why nobody at these endpoints accepts us, or we them; empty if that is not the cause."""
    for endpoint in endpoints:
        protocol = endpoint.partition("/")[0]
        if protocol == "tcp" and tls is None:
            if _speaks_tls(endpoint):
                return f"it speaks TLS: --connect {endpoint.replace('tcp/', 'tls/', 1)} --tls DIR"
        elif protocol in CERTIFIED and protocol != "quic" and (why := _handshake(endpoint, tls)):
            return why
    return ""


def _speaks_tls(endpoint: str) -> bool:
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    try:
        with _connected(endpoint) as plain, context.wrap_socket(plain):
            return True
    except OSError:  # also SSLError
        return False


def _handshake(endpoint: str, tls: Identity | None) -> str:
    """Returns what one side has against the other; empty if both accept, or if nobody is there."""
    host = host_of(endpoint)
    try:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        if tls is None:
            context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        else:
            context.load_verify_locations(tls.file(AUTHORITY))
            context.load_cert_chain(tls.file(CERTIFICATE), tls.file(KEY))
    except (OSError, ssl.SSLError) as error:
        return f"the certificate in {tls.folder if tls else ''} cannot be used: {error}"
    try:
        with _connected(endpoint) as plain, context.wrap_socket(plain, server_hostname=host) as secure:
            secure.recv(1)  # with TLS 1.3 its verdict comes behind the handshake
    except TimeoutError:
        return ""
    except ssl.SSLCertVerificationError as error:
        said = VERIFY.get(error.verify_code, f"its certificate is not accepted: {error.verify_message}")
        return said.format(folder=tls.folder if tls else "", host=host)
    except ssl.SSLError as error:
        reason = str(error.reason).upper()
        if "WRONG_VERSION" in reason or "RECORD_LAYER" in reason or "UNEXPECTED_EOF" in reason:
            return "it does not speak TLS: was it started with --tls?"
        return next((said for alert, said in ALERTS.items() if alert in reason), f"TLS fails there: {error.reason}")
    except OSError:
        return ""
    return ""


def _connected(endpoint: str) -> socket.socket:
    return socket.create_connection((host_of(endpoint), port_of(endpoint)), timeout=TIMEOUT)
