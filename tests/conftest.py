# SPDX-License-Identifier: MIT
"""What holds for all tests."""

import signal
from typing import Any

import pytest


def pytest_configure() -> None:
    """Programs that tests start end on Ctrl-C, also where a shell started the tests in the background: it lets them
    ignore it, and their children would inherit that."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Files of tests are dealt out to processes whole (--dist loadfile), those beside a GPU to one process: it has one
    GPU."""
    if config.getoption("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class ByFile(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return "gpu" if nodeid.startswith("tests/gpu/") else super()._split_scope(nodeid)

    return ByFile(config, log)
