# SPDX-License-Identifier: MIT
"""The queue of commands: rate limits by a given clock, bounded capacity, the newest move of each grab."""

import logging
from collections import Counter

from protocol.counters import Counters
from protocol.messages_pb2 import Command, Interaction, ObstacleTarget, Reply, Vector
from sim_server.network.command_queue import MAX_DEFERRED, CommandQueue
from sim_server.network.rate_limiter import MoveLimiter, RateLimiter, TokenBucket


class Harness:
    """A queue, its clock and the replies that came out of it."""

    def __init__(
        self, rate: float = 10.0, burst: float = 3.0, capacity: int = 64, moves: tuple[float, float] = (0.0, 0.0)
    ):
        self.now, self.counters, self.replies = 0.0, Counters(logging.getLogger("test")), {}
        limiter = RateLimiter(rate, burst)
        admitted = MoveLimiter(limiter, *moves, burst=min(burst, *moves))
        self.queue = CommandQueue(self.counters, limiter, capacity, lambda: self.now, admitted)
        self._count = 0

    def put(self, verb: str, client: str = "anna", id: int = 0, x: float = 0.0) -> int:
        """Puts a command; returns its number, under which `replies` will hold its reply."""
        self._count += 1
        number = self._count

        def reply(answer: Reply) -> None:
            assert number not in self.replies, "answered twice"
            self.replies[number] = answer.error

        interaction = Interaction(id=id, target=Vector(x=x))
        self.queue.put(Command(client=client, verb=verb, interaction=interaction), reply)
        return number

    def take_all(self) -> list[tuple[str, str, float]]:
        """Takes and answers all commands that may pass; returns (verb, client, x of the target) of each."""
        found = self.queue.take_all()
        for _, reply in found:
            reply(Reply())
        return [(c.verb, c.client, c.interaction.target.x) for c, _ in found]


def test_a_bucket_gives_its_burst_and_then_its_rate() -> None:
    bucket = TokenBucket(rate=10.0, burst=3.0, tokens=3.0, filled=100.0)
    assert [bucket.take(100.0) for _ in range(5)] == [True, True, True, False, False]
    assert not bucket.take(100.09) and bucket.take(100.11)
    assert sum(bucket.take(101 + 0.001 * i) for i in range(2000)) in (22, 23), "two seconds at 10 a second, and 3"
    assert not bucket.full(103.0) and bucket.full(103.4)
    assert sum(bucket.take(200.0) for _ in range(100)) == 3, "a long rest saves no more than the burst"


def test_a_bucket_may_owe_so_much_and_no_more() -> None:
    bucket = TokenBucket(rate=10.0, burst=3.0, tokens=0.0, filled=0.0)
    assert [bucket.take(0.0, debt=2.0) for _ in range(3)] == [True, True, False]
    assert not bucket.take(0.25) and bucket.take(0.31)


def test_a_clock_that_goes_back_gives_nothing() -> None:
    bucket = TokenBucket(rate=10.0, burst=3.0, tokens=1.0, filled=50.0)
    assert bucket.take(40.0) and not bucket.take(41.0)


def test_clients_have_buckets_of_their_own_in_bounded_memory() -> None:
    limiter = RateLimiter(rate=10.0, burst=2.0, clients=3)
    for name in ("a", "b", "c"):
        assert [limiter.allow(name, 0.0) for _ in range(3)] == [True, True, False]
    shared = sum(limiter.allow(f"invented-{i}", 0.0) for i in range(1000))
    assert shared == 2 and len(limiter) == 3, "names without a bucket share one"
    assert limiter.allow("d", 10.0) and len(limiter) <= 3, "full buckets are dropped"
    assert [limiter.allow("a", 10.0) for _ in range(3)] == [True, True, False]


def test_what_is_over_the_rate_is_refused_and_counted() -> None:
    harness = Harness(rate=10.0, burst=3.0)
    numbers = [harness.put("push") for _ in range(5)]
    others = [harness.put("push", "ben") for _ in range(2)]
    assert len(harness.take_all()) == 5
    assert [harness.replies[n] == "" for n in numbers] == [True, True, True, False, False]
    assert harness.replies[numbers[-1]] == "client 'anna' sends too much: at most 10 commands a second"
    assert all(harness.replies[n] == "" for n in others), "one client's flood is not another's"
    assert harness.counters.commands_refused == 2
    harness.now = 0.2
    harness.put("grab"), harness.put("grab"), harness.put("grab")
    assert len(harness.take_all()) == 2 and harness.counters.commands_refused == 3


def test_who_sends_too_much_can_still_let_go() -> None:
    harness = Harness(rate=10.0, burst=3.0)
    for _ in range(10):
        harness.put("push")
    assert [harness.replies.get(harness.put("release")) for _ in range(4)][:3] == [None] * 3
    assert [verb for verb, _, _ in harness.take_all()] == ["push"] * 3 + ["release"] * 3


def test_the_newest_move_of_a_grab_is_the_one_that_counts() -> None:
    harness = Harness()
    moves = [harness.put("move", id=7, x=float(i)) for i in range(50)]
    other = harness.put("move", id=8, x=-1.0)
    assert harness.take_all() == [("move", "anna", 49.0), ("move", "anna", -1.0)]
    assert all(harness.replies[n] == "" for n in [*moves, other])
    assert harness.counters.moves_replaced == 49 and harness.counters.commands_refused == 0


def test_moves_of_equal_numbers_by_two_clients_are_two() -> None:
    harness = Harness()
    harness.put("move", "anna", 7, 1.0), harness.put("move", "ben", 7, 2.0)
    assert harness.take_all() == [("move", "anna", 1.0), ("move", "ben", 2.0)]


def test_the_last_move_over_the_rate_waits_and_is_not_lost() -> None:
    harness = Harness(rate=10.0, burst=3.0)
    done = []
    for i in range(400):  # 1 kHz for 0.4 s
        harness.now = 0.001 * i
        harness.put("move", id=7, x=float(i))
        done += harness.take_all()
    assert 3 <= len(done) <= 8, "the rate holds"
    harness.now = 0.6
    assert harness.take_all() == [("move", "anna", 399.0)], "where the hand stopped"
    assert harness.take_all() == [] and len(harness.replies) == 400 and set(harness.replies.values()) == {""}
    assert harness.counters.commands_refused == 0 and harness.counters.moves_replaced == 400 - len(done) - 1


def test_a_device_has_each_of_its_moves_carried_out_and_its_commands_beside() -> None:
    harness = Harness(rate=10.0, burst=3.0, moves=(1000.0, 4000.0))
    done = []
    for i in range(400):  # 1 kHz for 0.4 s
        harness.now = 0.001 * i
        harness.put("move", id=7, x=float(i))
        done += harness.take_all()
    assert len(done) == 400 and harness.counters.moves_replaced == 0
    assert [harness.replies.get(harness.put("push")) for _ in range(3)] == [None] * 3, "moves take no commands away"


def test_a_crowd_of_devices_shares_what_all_may_move() -> None:
    harness, seconds = Harness(rate=10.0, burst=3.0, moves=(1000.0, 2000.0)), 1.0
    done = Counter()
    for i in range(int(1000 * seconds)):
        harness.now = 0.001 * i
        for client in range(8):
            harness.put("move", f"c{client}", 1, float(i))
        done.update(client for _, client, _ in harness.take_all())
    assert 2000 * seconds <= done.total() <= 2000 * seconds + 8 * (10 * seconds + 3) + 3
    assert all(done[f"c{client}"] >= 10 for client in range(8)), "each has at least what it has as commands"


def test_the_newest_move_of_an_obstacle_waits_and_is_not_lost() -> None:
    harness = Harness(rate=10.0, burst=1.0)
    for x, name in enumerate(("tool", "tool", "spoon", "tool", "spoon")):
        target = ObstacleTarget(obstacle=name, position=Vector(x=x))
        reply = harness.replies.setdefault
        harness.queue.put(
            Command(client="anna", verb="move_obstacle", target=target), lambda r, x=x, reply=reply: reply(x, r.error)
        )
    taken = [(c.target.obstacle, c.target.position.x) for c, _ in harness.queue.take_all()]
    assert taken == [("tool", 3.0)] and harness.replies == {0: "", 1: "", 2: ""}, "two wait, three were replaced"
    harness.now = 0.2
    assert [(c.target.obstacle, c.target.position.x) for c, _ in harness.queue.take_all()] == [("spoon", 4.0)]
    assert harness.counters.commands_refused == 0 and harness.counters.moves_replaced == 3


def test_a_full_queue_refuses_all_but_the_newest_moves() -> None:
    harness = Harness(rate=1e6, burst=1e6, capacity=4)
    kept = [harness.put("push", f"c{i}") for i in range(4)]
    surplus = harness.put("push", "late")
    moves = [harness.put("move", "late", 1, float(i)) for i in range(3)]
    assert harness.replies[surplus] == "the server is busy: 4 commands wait already"
    held = [harness.put("release", f"c{i}") for i in range(5)]
    assert harness.replies[held[4]] == "the server is busy: 8 commands wait already"
    assert len(harness.take_all()) == 8, "there is capacity left to let go, pause and stop"
    assert harness.take_all() == [("move", "late", 2.0)]
    assert all(harness.replies[n] == "" for n in [*kept, *moves])


def test_moves_that_wait_are_bounded_too() -> None:
    harness = Harness(rate=1e-3, burst=1.0)
    numbers = [harness.put("move", id=i) for i in range(3 * MAX_DEFERRED)]
    refused = [n for n in numbers if harness.replies.get(n)]
    assert len(refused) == 2 * MAX_DEFERRED - 1 == harness.counters.commands_refused
    assert len(harness.take_all()) == 1
