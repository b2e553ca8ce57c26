# SPDX-License-Identifier: MIT
"""What holds for all tests."""

import os
import signal
from pathlib import Path
from typing import Any

import pytest

# Threads of a loop that wait for one another sleep, before the library of OpenMP is loaded: where cores are shared with
# other processes they would spin for longer than they work.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

# Folders and files of tests that one process runs, when there are several: servers and workers in real time have the
# rest of the machine to themselves and one other process of tests; there is one GPU.
TOGETHER = {
    "tests/bench_smoke/test_benches_with_workers.py": "real time",
    "tests/clients/": "real time",
    "tests/faults/": "real time",
    "tests/gpu/": "GPU",
    "tests/system/": "real time",
    "tests/web/": "real time",
}

# Tests that take seconds each beside others of their kind that do not, a node id a line. They are marked `long`:
# deploy/run test leaves them out, deploy/run test --all and every other call of pytest run them.
LONG = Path(__file__).with_name("long_tests.txt")


def pytest_configure() -> None:
    """Programs that tests start end on Ctrl-C, also where a shell started the tests in the background: it lets them
    ignore it, and their children would inherit that."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Of several processes one begins with what takes longest because it waits, so that no other has to wait for it.

    A test of real processes, or beside them, that fails is made once more: it shares cores and network with the rest
    of the machine. What failed first is printed at the end (`pytest_terminal_summary`), so that it is not lost.
    """
    if hasattr(config, "workerinput"):
        items.sort(key=lambda item: _group(item.nodeid) != "real time")
    long = set(LONG.read_text().splitlines())
    whole = config.args_source is config.ArgsSource.TESTPATHS and not hasattr(config, "workerinput")
    if whole and (unknown := long - {item.nodeid for item in items}):
        raise pytest.UsageError(f"{LONG}: no such test: {', '.join(sorted(unknown))}")
    for item in items:
        if item.nodeid in long:
            item.add_marker(pytest.mark.long)
        if item.get_closest_marker("system") or _group(item.nodeid) == "real time":
            item.add_marker(pytest.mark.flaky(reruns=1))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Prints why tests were made a second time."""
    for report in terminalreporter.stats.get("rerun", []):
        terminalreporter.write_sep("=", f"failed at first: {report.nodeid}")
        terminalreporter.write_line(report.longreprtext)
        for title, text in report.sections:
            terminalreporter.write_line(f"--- {title}\n{text}")


def _group(nodeid: str) -> str | None:
    """What a test is run together with, other than its file."""
    return next((group for start, group in TOGETHER.items() if nodeid.startswith(start)), None)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """--dist loadfile deals out files of tests whole, what is TOGETHER as if it were one file."""
    if config.getoption("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class Together(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return _group(nodeid) or super()._split_scope(nodeid)

    return Together(config, log)
