# SPDX-License-Identifier: MIT
"""Sessions: they end, they listen only where told, they never block, and they know when not to share memory."""

import os
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import zenoh
from hand_worker import HandWorker
from link_helpers import ROOT, Driver, chain, dense, light_worker, matrix, process, product

from protocol.channels import DEFAULT_ENDPOINT, key
from protocol.messages_pb2 import Status
from protocol.network.endpoints import BadEndpoint
from protocol.network.session import EXTRA_CONFIG, ConnectionFailed, open_session
from protocol.shared_memory import limits as shm_limits
from sim_server.network.link import ServerLink
from tests.ports import free_endpoint

pytestmark = pytest.mark.system

UNCAUGHT = """
import sys, time
from protocol.network.session import open_session
session = open_session("server", listen=[sys.argv[1]])
subscriber = session.zenoh.declare_subscriber("a/*", lambda sample: None)
queryable = session.zenoh.declare_queryable("b/*", lambda query: None)
ring = session.zenoh.declare_subscriber("c/*")
def listen():
    try:
        ring.recv()
    except Exception:
        pass
session.thread("listener", listen)
time.sleep(0.1)
{end}
"""
LINK = """
import sys
from sim_server.network.link import ServerLink
link = ServerLink(listen=[sys.argv[1]])
{end}
"""


@pytest.mark.parametrize("program", [UNCAUGHT, LINK], ids=["session", "link"])
@pytest.mark.parametrize(("end", "code"), [("raise RuntimeError('uncaught')", 1), ("", 0), ("sys.exit(3)", 3)])
def test_a_process_that_never_closes_its_session_still_ends(program: str, end: str, code: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", program.format(end=end), free_endpoint()],
        cwd=ROOT,
        timeout=30,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == code, done.stderr
    assert "uncaught" in done.stderr if code == 1 else done.stderr == ""


def open_sockets() -> set[str]:
    """Sockets of this process."""
    found = set()
    for fd in os.listdir("/proc/self/fd"):
        try:
            target = os.readlink(f"/proc/self/fd/{fd}")
        except OSError:
            continue
        if target.startswith("socket:["):
            found.add(target[8:-1])
    return found


def sockets_in(table: str, inodes: set[str]) -> set[str]:
    """Local address:port in hexadecimal of those sockets in /proc/net/TABLE that listen or are bound."""
    lines = [line.split() for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]]
    return {words[1] for words in lines if words[9] in inodes and (words[3] == "0A" or table.startswith("udp"))}


def test_only_loopback_listens_unless_asked() -> None:
    assert DEFAULT_ENDPOINT.startswith("tcp/127.0.0.1:")
    endpoint = free_endpoint()
    port = f"{int(endpoint.rsplit(':', 1)[1]):04X}"
    before = open_sockets()
    with ServerLink(listen=[endpoint]), open_session("client", connect=[endpoint]):
        mine = open_sockets() - before
        assert sockets_in("tcp", mine) == {f"0100007F:{port}"}
        assert not sockets_in("tcp6", mine) and not sockets_in("udp", mine) and not sockets_in("udp6", mine)


def test_no_answer_and_a_port_in_use_are_one_clear_message() -> None:
    endpoint = free_endpoint()
    with pytest.raises(ConnectionFailed, match=rf"^cannot connect to {endpoint}: no answer$"):
        open_session("client", connect=[endpoint], timeout=0.2)
    with (
        open_session("server", listen=[endpoint]),
        pytest.raises(ConnectionFailed, match="Address already in use") as failed,
    ):
        open_session("server", listen=[endpoint])
    assert "\n" not in str(failed.value) and ".rs" not in str(failed.value)
    with pytest.raises(BadEndpoint, match="cannot be used"):
        open_session("client", connect=["nonsense"])


def test_a_configuration_file_that_is_not_there_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(EXTRA_CONFIG, "/nowhere/zenoh.json5")
    with pytest.raises(BadEndpoint, match=r"WARPFACTOR_ZENOH_CONFIG=/nowhere/zenoh.json5 cannot be used"):
        open_session("client", connect=[free_endpoint()])


def test_users_of_a_configuration_file_need_the_password(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint = free_endpoint()
    (tmp_path / "users.txt").write_text("alice:secret\n")
    files = {
        "server": f'{{transport:{{auth:{{usrpwd:{{user:"s",password:"p",dictionary_file:"{tmp_path}/users.txt"}}}}}}}}',
        "good": '{transport:{auth:{usrpwd:{user:"alice",password:"secret"}}}}',
        "bad": '{transport:{auth:{usrpwd:{user:"alice",password:"guess"}}}}',
    }
    for name, text in files.items():
        (tmp_path / f"{name}.json5").write_text(text)

    def use(name: str) -> None:
        monkeypatch.setenv(EXTRA_CONFIG, str(tmp_path / f"{name}.json5"))

    use("server")
    with ServerLink(listen=[endpoint]):
        use("good")
        open_session("client", connect=[endpoint]).close()
        use("bad")
        with pytest.raises(ConnectionFailed, match="no answer"):
            open_session("client", connect=[endpoint], timeout=0.3)


def test_what_nobody_takes_blocks_nobody() -> None:
    """A service thread that sleeps: 5000 messages arrive, queries are still answered, nothing grows without bound."""
    endpoint = free_endpoint()
    with (
        ServerLink(listen=[endpoint], shared_memory=False, silence=60) as link,
        HandWorker(endpoint, link.incarnation) as hand,
    ):
        link.publish_status(Status(scene="asleep"))
        for _ in range(2500):
            hand.hello()
            hand.put("factor", b"x" * 100, b"y" * 100, worker="hand", object="beam")
        replies = list(hand.session.zenoh.get(key("status"), timeout=10))
        assert [Status.FromString(bytes(reply.ok.payload)).scene for reply in replies if reply.ok] == ["asleep"]
        driver = Driver(link)
        link.announce(chain())
        driver.until(link.dispatch.ready, "the worker")
        assert 0 < link.counters.refused <= 2500
        driver.submit(chain(), 1)
        hand.answer(*hand.right_answer(hand.receive(), chain()))
        driver.until(lambda: driver.factors, "a factor")


def test_too_little_lockable_memory_loses_nothing() -> None:
    endpoint = free_endpoint()
    here = Path(__file__).parent
    probe = subprocess.run(
        [sys.executable, str(here / "limited.py"), "64", os.devnull], capture_output=True, text=True, check=False
    )
    if probe.returncode != 0:
        pytest.skip(f"capabilities cannot be dropped here: {probe.stderr.splitlines()[-1]}")
    topology = chain(40)
    with (
        ServerLink(listen=[endpoint]) as link,
        process(str(here / "limited.py"), "64", str(here / "light_worker.py"), endpoint, "poor") as child,
    ):
        driver = Driver(link)
        link.announce(topology)
        for step in range(1, 11):
            factor = driver.factor(topology, step, 0.1 * step)
            assert np.allclose(product(factor), dense(topology, matrix(topology, 0.1 * step)), atol=1e-4)
        assert not link.dispatch.workers()[0].shared_memory
        assert link.counters.refused == 0 and link.counters.leases_over == 0
        child.terminate()
        _, errors = child.communicate(timeout=20)
        assert errors.count("locked-memory limit is 64 KiB") == 1


def test_the_limit_counts_only_without_the_capability(monkeypatch: pytest.MonkeyPatch) -> None:
    limits = {resource.RLIMIT_MEMLOCK: 8 << 20}
    unlimited = resource.RLIM_INFINITY
    monkeypatch.setattr(resource, "getrlimit", lambda which: (limits.get(which, unlimited),) * 2)
    monkeypatch.setattr(shm_limits, "may_lock_anything", lambda: False)
    assert "locked-memory limit is 8192 KiB" in shm_limits.obstacle()
    assert shm_limits.obstacle() and not open_and_close(free_endpoint())
    monkeypatch.setattr(shm_limits, "may_lock_anything", lambda: True)
    assert shm_limits.obstacle() == ""
    limits[resource.RLIMIT_FSIZE] = 8 << 20
    assert "files may have 8192 KiB" in shm_limits.obstacle()
    monkeypatch.setattr(shm_limits, "SHM", Path("/nowhere"))
    assert "is not writable" in shm_limits.obstacle()


def open_and_close(endpoint: str) -> bool:
    """Whether a server there would share memory."""
    with ServerLink(listen=[endpoint]) as link:
        return link.shared_memory


def test_no_memory_left_for_slots_means_bytes() -> None:
    endpoint, topology = free_endpoint(), chain(40)
    if shm_limits.obstacle():
        pytest.skip("no shared memory here")
    with ServerLink(listen=[endpoint], slots=33_000) as link, light_worker(endpoint):
        driver = Driver(link)
        link.announce(topology)
        for step in range(1, 4):
            factor = driver.factor(topology, step, 0.1 * step)
            assert np.allclose(product(factor), dense(topology, matrix(topology, 0.1 * step)), atol=1e-4)
        assert link.counters.slots_exhausted >= 1
        assert link.dispatch.workers()[0].shared_memory


def test_closing_twice_and_publishing_late_do_no_harm() -> None:
    link = ServerLink(listen=[free_endpoint()])
    link.close()
    link.close()
    session = open_session("server", listen=[free_endpoint()])
    session.close()
    with pytest.raises(zenoh.ZError):
        session.zenoh.put("a", b"")
