# SPDX-License-Identifier: MIT
"""Serves metrics over HTTP, /metrics in the text format of Prometheus and /healthy, from one thread of its own.

One request is served at a time and none may take longer than TIMEOUT between two reads, so that whoever reaches the
port may hold up other scrapes for a while and nothing else.
"""

import socket
import threading
from collections.abc import Callable, Iterable
from importlib.util import find_spec
from socketserver import TCPServer
from typing import Any, Self
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from protocol.network.web_address import shown, web_address
from protocol.process.extras import to_install
from protocol.refused import Refused

PORT = 9464  # of exporters of OpenTelemetry and others, for an address without one
TIMEOUT = 2.0  # s
PLAIN = ("Content-Type", "text/plain; charset=utf-8")


class _Handler(WSGIRequestHandler):
    timeout = TIMEOUT

    def log_message(self, format: str, *args: Any) -> None:
        """Says nothing: a line for each scrape helps nobody."""


class _Server(WSGIServer):
    def server_bind(self) -> None:
        """Binds without a look at the name of the address, which may take as long as a name server does not answer."""
        TCPServer.server_bind(self)
        host, self.server_port = self.server_address[:2]
        self.server_name = str(host)
        self.setup_environ()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Says nothing of a client that went away."""


def metrics_address(text: str) -> tuple[str, int]:
    """Returns host and port of HOST:PORT, or of PORT or HOST alone: at 127.0.0.1, at PORT.

    Raises Refused for anything else, or without the package that metrics need.
    """
    address = web_address(text, "--metrics", PORT)
    if find_spec("prometheus_client") is None:
        raise Refused(f"--metrics needs the package prometheus_client, of the extra metrics: {to_install('metrics')}")
    return address


class MetricsServer:
    """Serves what `collector` collects, a collector of prometheus_client.

    unhealthy: returns why the process is not healthy, and /healthy answers 503; empty: it is. Raises Refused for an
    address that cannot be used.
    """

    def __init__(self, host: str, port: int, collector: Any, unhealthy: Callable[[], str] = lambda: ""):
        from prometheus_client import CollectorRegistry, ProcessCollector, make_wsgi_app

        registry = CollectorRegistry()
        registry.register(collector)
        ProcessCollector(registry=registry)
        metrics = make_wsgi_app(registry)

        def answer(environ: dict[str, Any], start: Callable[..., Any]) -> Iterable[bytes]:
            path = environ.get("PATH_INFO")
            if path == "/metrics":
                found: Iterable[bytes] = metrics(environ, start)
                return found
            if path == "/healthy":
                why = unhealthy()
                start("503 Service Unavailable" if why else "200 OK", [PLAIN])
                return [f"{why or 'ok'}\n".encode()]
            start("404 Not Found", [PLAIN])
            return [b"/metrics and /healthy are here\n"]

        self.url = f"http://{shown(host, port)}/metrics"
        try:
            family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
            bound = type("_Bound", (_Server,), {"address_family": family})
            self._server: WSGIServer = make_server(host, port, answer, bound, _Handler)
        except (OSError, UnicodeError) as error:
            why = getattr(error, "strerror", None) or error
            raise Refused(f"--metrics: metrics cannot be served at {shown(host, port)}: {why}") from None
        self._thread = threading.Thread(target=self._server.serve_forever, name="metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Answers no more."""
        self._server.shutdown()
        self._thread.join(2 * TIMEOUT)
        self._server.server_close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
