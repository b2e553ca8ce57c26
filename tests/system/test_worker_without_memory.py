# SPDX-License-Identifier: MIT
"""A worker that has no more memory or threads ends with one line and code 1, and a supervisor may start another."""

import resource
from pathlib import Path

import pytest
from link_helpers import Driver, chain, process

from protocol.process.exhausted import exhausted
from sim_server.network.link import ServerLink
from tests.ports import free_endpoint

pytestmark = pytest.mark.system

BEAM = chain()
SCRIPT = str(Path(__file__).parent / "failing_worker.py")


@pytest.mark.parametrize(
    ("where", "line"),
    [
        ("heartbeat", f"thread heartbeat failed: {exhausted(RuntimeError('start new thread'))}; the worker ends"),
        ("take_in", "out of memory; the worker ends"),
        ("loading", "out of memory: /lib/x.so: failed to map segment from shared object; the worker ends"),
    ],
)
def test_it_ends_with_one_line(where: str, line: str) -> None:
    endpoint = free_endpoint()
    with (
        ServerLink(listen=[endpoint], shared_memory=False) as link,
        process(SCRIPT, where, "--connect", endpoint, "--name", "poor", "--no-shared-memory") as child,
    ):
        driver = Driver(link)
        link.announce(BEAM)
        if where == "loading":
            driver.submit(BEAM, 1)
            driver.until(lambda: driver.failures, "the job to be refused")
            assert "failed to map segment" in driver.failures[0][1]
        _, err = child.communicate(timeout=30)
        assert child.returncode == 1
        assert err == f"precond-worker: {line}\n"
        driver.until(lambda: not link.dispatch.workers(), "it to be gone")


def test_under_a_limit_of_memory_it_serves_or_ends_but_does_not_stay_half_alive() -> None:
    endpoint, bound = free_endpoint(), 700 << 20
    with (
        ServerLink(listen=[endpoint], shared_memory=False) as link,
        process(
            "-m", "precond_worker", "--connect", endpoint, "--name", "poor",
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, (bound, bound)),
        ) as child,
    ):  # fmt: skip
        driver = Driver(link)
        driver.until(lambda: link.dispatch.workers() or child.poll() is not None, "it to serve or to end")
        if child.poll() is not None:
            _, err = child.communicate(timeout=30)
            assert child.returncode != 0 and err and "Traceback" not in err
