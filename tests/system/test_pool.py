# SPDX-License-Identifier: MIT
"""One pool of workers for several servers: found, shared in turn, over a router, whoever starts first."""

import contextlib
import json
import time
from collections.abc import Iterator

import pytest
import zenoh
from link_helpers import PATIENCE, ROOT, Driver, chain, light_worker, matrix, process

from protocol.network.session import open_session
from sim_server.network.link import ServerLink
from sim_server.updates.factor_source import Job
from tests.ports import free_endpoint

pytestmark = pytest.mark.system


@contextlib.contextmanager
def servers(*where: tuple[str, str], **options: object) -> Iterator[list[Driver]]:
    """A server of each (name, endpoint), each with an object of its own."""
    with contextlib.ExitStack() as stack:
        drivers = []
        for k, (name, endpoint) in enumerate(where):
            link = stack.enter_context(ServerLink(name, [endpoint], **options))  # type: ignore[arg-type]
            link.announce(chain(5 + k))
            drivers.append(Driver(link))
        yield drivers


def worker(*arguments: str, name: str = "shared") -> contextlib.AbstractContextManager:
    return process("-m", "precond_worker", "--name", name, *arguments)


def factors(driver: Driver, nodes: int, count: int, first: int = 1) -> set[str]:
    """So many good factors; who made them."""
    return {driver.factor(chain(nodes), first + k, 0.1 * k).worker for k in range(count)}


def test_two_servers_share_one_worker() -> None:
    a, b = free_endpoint(), free_endpoint()
    with (
        servers(("sim-0", a), ("sim-1", b)) as (first, second),
        worker("--server", f"sim-0@{a}", "--server", f"sim-1@{b}") as child,
    ):
        for k in range(5):
            assert factors(first, 5, 1, k + 1) == factors(second, 6, 1, k + 1) == {"shared"}
        pids = {driver.link.dispatch.workers()[0].pid for driver in (first, second)}
        assert pids == {child.pid}
        for driver in (first, second):
            assert driver.link.counters.refused == 0 and driver.failures == []


def test_both_get_factors_while_both_ask_all_the_time() -> None:
    a, b = free_endpoint(), free_endpoint()
    with servers(("sim-0", a), ("sim-1", b)) as pair, worker("--server", f"sim-0@{a}", "--server", f"sim-1@{b}"):
        objects, step = [chain(5), chain(6)], 0
        while min(len(driver.factors) for driver in pair) < 20:
            step += 1
            for driver, topology in zip(pair, objects, strict=True):
                driver.submit(topology, step)
        counts = [len(driver.factors) for driver in pair]
        assert abs(counts[0] - counts[1]) <= 2, "a job of each in turn"


def test_every_server_of_a_router_is_found_also_those_to_come() -> None:
    """The servers know the router alone, as on hosts of their own; so does the worker."""
    router = free_endpoint()
    with open_session("server", listen=[router]), worker("--connect", router, "--server", "*") as child:
        with servers(("early", free_endpoint()), connect=[router]) as (early,):
            assert factors(early, 5, 3) == {"shared"}
            with servers(("late", free_endpoint()), connect=[router]) as (late,):
                assert factors(late, 5, 3) == {"shared"}
                assert factors(early, 5, 3, 10) == {"shared"}
            assert factors(early, 5, 3, 20) == {"shared"}, "one of its servers left"
        with servers(("early", free_endpoint()), connect=[router]) as (again,):
            assert factors(again, 5, 3) == {"shared"}, "a server came back with another incarnation"
            assert again.link.dispatch.workers()[0].pid == child.pid


def test_workers_at_the_router_and_at_the_server_itself_both_work() -> None:
    router, own = free_endpoint(), free_endpoint()
    with open_session("server", listen=[router]), servers(("sim", own), connect=[router]) as (sim,):
        topologies = [chain(5, "a"), chain(6, "b")]
        for topology in topologies:
            sim.link.announce(topology)
        with worker("--connect", router, name="far"), worker("--connect", own, name="near"):
            sim.until(lambda: len(sim.link.dispatch.workers()) == 2, "both workers")
            step = 0
            while {factor.worker for factor in sim.factors} != {"far", "near"}:
                step += 1
                assert step < 100
                for topology in topologies:
                    sim.submit(topology, step)
        sim.until(lambda: not sim.link.dispatch.workers(), "both to leave")


def test_a_server_that_is_not_there_holds_up_no_other() -> None:
    here, nowhere = free_endpoint(), free_endpoint()
    with worker("--server", f"gone@{nowhere}", "--server", f"sim@{here}") as child:
        assert child.stderr is not None
        assert "trying until the server is there" in child.stderr.readline()  # started before any server
        with servers(("sim", here)) as (sim,):
            assert factors(sim, 5, 5) == {"shared"}
            with servers(("gone", nowhere)) as (gone,):
                assert factors(gone, 5, 2) == {"shared"}


def test_a_server_starts_again_while_the_other_is_served() -> None:
    a, b = free_endpoint(), free_endpoint()
    with worker("--server", f"sim-0@{a}", "--server", f"sim-1@{b}") as child, servers(("sim-1", b)) as (lasting,):
        incarnations = set()
        for life in range(2):
            with servers(("sim-0", a)) as (passing,):
                incarnations.add(passing.link.incarnation)
                assert factors(passing, 5, 2) == {"shared"}
                assert factors(lasting, 5, 2, 10 * life + 1) == {"shared"}
        assert len(incarnations) == 2
        assert factors(lasting, 5, 2, 100) == {"shared"}
        assert child.poll() is None


def test_a_faster_worker_gets_the_object_when_both_are_idle() -> None:
    endpoint = free_endpoint()
    with (
        servers(("sim", endpoint)) as (sim,),
        light_worker(endpoint, "slow", "slow=0.2"),
        light_worker(endpoint, "fast"),
    ):
        sim.until(lambda: len(sim.link.dispatch.workers()) == 2, "both workers")
        for topology in (chain(5, "a"), chain(6, "b")):
            sim.link.announce(topology)
        step = 0
        while len({(factor.worker, factor.object) for factor in sim.factors}) < 4:  # each has tried each
            step += 1
            assert step < 100
            for object, nodes in (("a", 5), ("b", 6)) if step % 2 else (("b", 6), ("a", 5)):
                sim.submit(chain(nodes, object), step)
        sim.until(lambda: not sim.link.dispatch.leases.jobs, "both to be idle")
        sim.factors.clear()
        for k in range(5):
            assert sim.factor(chain(5, "a"), 1000 + k).worker == "fast"
            sim.until(lambda: not sim.link.dispatch.leases.jobs, "both to be idle")


def test_workers_go_where_they_are_needed_most_and_lose_no_job() -> None:
    router = free_endpoint()
    demands = {"light": 1.0, "heavy": 2.2}
    with contextlib.ExitStack() as stack:
        stack.enter_context(open_session("server", listen=[router]))
        names = [(name, free_endpoint()) for name in demands]
        light, heavy = stack.enter_context(servers(*names, connect=[router]))
        pair = {"light": (light, chain(5)), "heavy": (heavy, chain(6))}
        for k in range(3):
            stack.enter_context(worker("--connect", router, "--server", "*", name=f"w{k}"))
        step = due = 0.0

        def counts() -> dict[str, int]:
            """Has both make jobs and tell their needs; returns how many workers each has."""
            nonlocal step, due
            step += 1
            found = {name: len(driver.link.dispatch.workers()) for name, (driver, _) in pair.items()}
            tells = time.monotonic() >= due
            for name, (driver, topology) in pair.items():
                driver.turn()
                job = Job(topology.header.object, 1, int(step), True, matrix(topology), "float32")
                if driver.link.dispatch.ready():
                    driver.link.dispatch.submit(job)
                if tells:
                    driver.link.publish_need(demands[name] / max(found[name], 0.5))
            due = time.monotonic() + 0.3 if tells else due
            time.sleep(0.01)
            return found

        def until(wanted: dict[str, int], seconds: float = 0.0) -> None:
            """Until it is so, and stays so."""
            now = time.monotonic()
            end, since = now + PATIENCE, now
            while (found := counts()) != wanted or time.monotonic() - since < seconds:
                assert time.monotonic() < end, found
                since = since if found == wanted else time.monotonic()

        until({"light": 1, "heavy": 2}, 4.0)
        demands["light"] = 12.0
        until({"light": 2, "heavy": 1})
        assert light.factors and heavy.factors
        assert light.failures == heavy.failures == [], "who leaves answers its last job"
        heavy.link.close()
        del pair["heavy"]
        until({"light": 3})


def test_the_router_that_comes_along_is_one() -> None:
    """deploy/zenoh/router.json5, at another endpoint: a server and a worker meet in it."""
    config = zenoh.Config.from_file(str(ROOT / "deploy" / "zenoh" / "router.json5"))
    router = free_endpoint()
    config.insert_json5("listen/endpoints", json.dumps([router]))
    with (
        zenoh.open(config),
        worker("--connect", router, "--server", "*"),
        servers(("sim", free_endpoint()), connect=[router]) as (sim,),
    ):
        assert factors(sim, 5, 2) == {"shared"}
