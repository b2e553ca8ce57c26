# SPDX-License-Identifier: MIT
"""The rerun viewer as a child process in a process group of its own, reachable from this machine only."""

from __future__ import annotations

import importlib.util
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import quote

from clients.errors import ClientError
from protocol.process.extras import to_install

START_SECONDS = 30.0


def viewer_binary() -> Path:
    """Returns the path of the viewer itself: the command `rerun` is a Python wrapper that leaves it running."""
    spec = importlib.util.find_spec("rerun_cli")
    if spec is None or spec.origin is None:
        raise ClientError(f"rerun-sdk is not installed, of the extra view: {to_install('view')}")
    return Path(spec.origin).with_name("rerun")


def has_display() -> bool:
    """True if windows can be shown."""
    return sys.platform != "linux" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))


def free_port() -> int:
    """Returns a free port of the loopback interface."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


class Viewer:
    """A running viewer: a window, or with `web` a page for a browser of this machine at `page`.

    Raises ClientError if it does not come up.
    """

    def __init__(self, web: bool) -> None:
        port, page_port = free_port(), free_port()
        self.url = f"rerun+http://127.0.0.1:{port}/proxy"
        self.page = ""
        command = [str(viewer_binary()), "--bind", "127.0.0.1", "--port", str(port), "--expect-data-soon"]
        if web:
            command += ["--serve-web", "--web-viewer-port", str(page_port)]
            self.page = f"http://127.0.0.1:{page_port}?url={quote(self.url, safe='')}"
        environment = os.environ | {"RERUN_APP_ONLY": "true", "RUST_LOG": os.environ.get("RUST_LOG", "error")}
        self._process = subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, start_new_session=True)
        try:
            self._wait_for(port)
        except BaseException:
            self.close()
            raise

    def running(self) -> bool:
        """True until the viewer has ended."""
        return self._process.poll() is None

    def wait(self) -> None:
        """Waits until its window is closed."""
        while self.running():
            time.sleep(0.2)

    def close(self) -> None:
        """Ends the viewer and the processes that it started."""
        if self.running():
            os.killpg(self._process.pid, signal.SIGTERM)
            try:
                self._process.wait(5)
            except subprocess.TimeoutExpired:
                os.killpg(self._process.pid, signal.SIGKILL)
                self._process.wait()

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wait_for(self, port: int) -> None:
        deadline = time.monotonic() + START_SECONDS
        while self.running() and time.monotonic() < deadline:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    return
            time.sleep(0.05)
        raise ClientError(f"the rerun viewer did not start (exit status {self._process.poll()})")
