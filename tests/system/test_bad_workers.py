# SPDX-License-Identifier: MIT
"""Workers that keep their jobs or send what is no use beside a good one: it gets the jobs."""

from contextlib import ExitStack

import pytest
from hand_worker import HandWorker
from link_helpers import Driver, chain

from sim_server.network.link import ServerLink
from tests.ports import free_endpoint

pytestmark = pytest.mark.system

BEAM = chain()
FAKES = 20


class Stage:
    """A server, a worker that is good and some that are not, played by hand, and a clock that is put forward."""

    def __init__(self, closing: ExitStack):
        self.now = 0.0
        self.endpoint = free_endpoint()
        self.link = closing.enter_context(
            ServerLink(listen=[self.endpoint], shared_memory=False, silence=1e9, clock=lambda: self.now)
        )
        self.driver, self.closing = Driver(self.link), closing
        self.link.announce(BEAM)

    def worker(self, name: str) -> HandWorker:
        known = len(self.link.dispatch.workers())
        hand = self.closing.enter_context(HandWorker(self.endpoint, self.link.incarnation, name))
        hand.hello()
        self.driver.until(lambda: len(self.link.dispatch.workers()) > known, name)
        return hand

    def asked(self, step: int, *workers: HandWorker) -> HandWorker:
        """Who gets the job of this step; one of the workers."""
        self.driver.submit(BEAM, step)
        return self.driver.until(lambda: next((w for w in workers if w.has_job()), None), "a job")

    def answers(self, hand: HandWorker, step: int) -> None:
        self.now += 0.02
        hand.answer(*hand.right_answer(hand.receive(), BEAM))
        self.driver.until(lambda: self.driver.factors and self.driver.factors[-1].step == step, "the factor")


def test_who_keeps_his_jobs_gets_one_and_the_others_go_to_who_answers() -> None:
    """Twenty that never answer: before, each got a job in turn and each kept the object longer than the last."""
    with ExitStack() as closing:
        stage = Stage(closing)
        real = stage.worker("real")
        assert stage.asked(1, real) is real
        stage.answers(real, 1)
        fakes = [stage.worker(f"fake{k}") for k in range(FAKES)]
        answered, kept, step = 0, 0, 1
        while stage.now < 20.0:
            step += 1
            hand = stage.asked(step, real, *fakes)
            if hand is real:
                stage.answers(real, step)
                answered += 1
            else:
                hand.receive()
                kept += 1
                stage.now += 0.6
                stage.driver.until(lambda: stage.link.dispatch.reassigned() == ["beam"], "the object to be free again")
            stage.now += 0.1
        assert kept <= 2 and answered > 150
        assert stage.driver.failures == [] and stage.link.counters.leases_over == 0


def test_a_newcomer_that_is_slow_at_first_gets_more_jobs_once_it_has_answered() -> None:
    with ExitStack() as closing:
        stage = Stage(closing)
        real = stage.worker("real")
        assert stage.asked(1, real) is real
        stage.answers(real, 1)
        new = stage.worker("new")
        assert stage.asked(2, real, new) is new, "it is tried"
        late = new.receive()
        stage.now += 50.0  # it compiles
        stage.driver.until(lambda: stage.link.dispatch.reassigned() == ["beam"], "the object to be free again")
        assert stage.asked(3, real, new) is real
        stage.answers(real, 3)
        new.answer(*new.right_answer(late, BEAM))
        stage.driver.until(lambda: stage.link.dispatch.ready() == 2, "both")
        assert [f.step for f in stage.driver.factors] == [1, 3] and stage.link.counters.refused == 0
        assert stage.driver.failures == []


def test_a_worker_that_says_that_it_has_no_job_gets_another_one() -> None:
    """Its first job was lost, of which an answer may take minutes. It is busy with the second one."""
    with ExitStack() as closing:
        stage = Stage(closing)
        only = stage.worker("only")

        def says(idle: bool, seconds: float) -> None:
            for _ in range(round(seconds / 0.2)):
                stage.now += 0.2
                only.hello(idle=idle)
                stage.driver.until(
                    lambda: stage.link.dispatch.workers()[0].header.sequence == only.sequence, "the heartbeat to come"
                )

        says(True, 2.0)
        assert stage.asked(1, only) is only
        only.receive()
        says(True, 0.8)
        assert stage.driver.failures == [], "it may be on its way"
        says(True, 0.6)
        stage.driver.until(lambda: stage.driver.failures, "the loss to be seen")
        why = "was lost: worker only says that it has no job"
        assert stage.driver.failures == [("beam", f"factorization of beam at step 1 {why}")]
        assert stage.link.counters.jobs_lost == 1
        assert stage.asked(2, only) is only
        says(False, 30.0)
        stage.answers(only, 2)
        assert len(stage.driver.failures) == 1 and stage.link.counters.refused == 0


def test_the_jobs_of_who_fails_go_to_who_does_not() -> None:
    """Per worker: before, the object was held back for all, and the good worker with it."""
    with ExitStack() as closing:
        stage = Stage(closing)
        good, bad = stage.worker("good"), stage.worker("bad")
        got, step = {"good": 0, "bad": 0}, 0
        while step < 60:
            step += 1
            hand = stage.asked(step, good, bad)
            got[hand.name] += 1
            if hand is good:
                stage.answers(good, step)
            else:
                answer, values = bad.right_answer(bad.receive(), BEAM)
                values[0] = -1.0
                failed = len(stage.driver.failures)
                bad.answer(answer, values)
                stage.driver.until(lambda failed=failed: len(stage.driver.failures) > failed, "the refusal")
            assert stage.link.dispatch.consecutive_failures() in ({}, {"beam": 0}), "there is a good one"
            stage.now += 0.05
        assert got["good"] > 50


def test_an_object_waits_for_the_good_worker_rather_than_going_to_the_bad() -> None:
    with ExitStack() as closing:
        stage = Stage(closing)
        good, bad = stage.worker("good"), stage.worker("bad")
        for _ in range(3):
            stage.link.dispatch.factor_failed("bad", "beam")
        stage.link.announce(chain(object="bar"))
        stage.driver.until(lambda: stage.link.dispatch.ready() == 2, "both")
        assert stage.asked(1, good, bad) is good
        assert stage.link.dispatch.reserved() == {"beam"}, "in hand of the good one, and nothing for the bad"
        stage.answers(good, 1)
        assert stage.link.dispatch.reserved() == set()
        stage.link.dispatch.factor_helped("bad", "beam")
        assert stage.link.dispatch.consecutive_failures() == {}


def test_if_all_fail_all_are_asked_less_and_less() -> None:
    with ExitStack() as closing:
        stage = Stage(closing)
        for name in ("one", "two"):
            stage.worker(name)
            stage.link.dispatch.factor_failed(name, "beam")
        stage.link.dispatch.factor_failed("two", "beam")
        assert stage.link.dispatch.consecutive_failures() == {"beam": 1} and stage.link.dispatch.reserved() == set()
