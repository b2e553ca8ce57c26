# SPDX-License-Identifier: MIT
"""Several clients of a load test in one process: half of them push, half hold and move, each at its rate.

Run by load.py: a plan as one line of JSON on stdin, "ready" on stdout once all are connected, a line on stdin to begin,
then what became of it as JSON on stdout. Commands are sent when they are due, whether or not the last was answered.
"""

from __future__ import annotations

import contextlib
import heapq
import json
import math
import os
import random
import re
import signal
import sys
import threading
import time
from collections import Counter, deque
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from clients.client import Client, vector
from clients.errors import BadInput, ClientError
from protocol import messages_pb2 as pb

OPEN = 256  # commands of one client that may be unanswered; beyond that it skips
KEPT = 20_000  # reply times of a client
PUSH = 0.1  # s of simulation
NICE = 10  # where server and clients share the cores, it is not the clients that are to be measured
CIRCLE = 0.5  # turns a second of a grab's target


class Hand:
    """One client. plan: object, at [m], force [N], reach [m], rate [1/s], grabs, seed."""

    def __init__(self, client: Client, plan: dict[str, Any]):
        self.client, self.plan = client, plan
        self.draw = random.Random(plan["seed"])
        self.counts: Counter[str] = Counter(sent=0, done=0, refused=0, unanswered=0, skipped=0)
        self.reasons: Counter[str] = Counter()
        self.seconds: deque[float] = deque(maxlen=KEPT)
        self._open, self._lock = 0, threading.Lock()
        self._held: int | None = None  # id of the grab
        self._taking = False

    def act(self, now: float) -> None:
        """What is due: a push, the grab, or the next place of its target."""
        with self._lock:
            if self._open >= OPEN:
                self.counts["skipped"] += 1
                return
            self._open += 1
            self.counts["sent"] += 1
        verb, wanted = self._next(now)
        sent = time.monotonic()
        self.client.send(verb, wanted, lambda reply: self._answered(verb, reply, sent))

    def _next(self, now: float) -> tuple[str, pb.Interaction]:
        p = self.plan
        place = vector(p["at"], "at")
        if not p["grabs"]:
            way = [self.draw.gauss(0, 1) for _ in range(3)]
            size = p["force"] * self.draw.uniform(0.2, 1.0) / max(math.hypot(*way), 1e-9)
            force = vector([size * w for w in way], "force")
            return "push", pb.Interaction(object=p["object"], kind="push", point=place, force=force, duration=PUSH)
        angle = 2 * math.pi * CIRCLE * now
        x, y, z = p["at"]
        target = vector([x + p["reach"] * math.sin(angle), y + p["reach"] * (math.cos(angle) - 1), z], "target")
        if self._held is not None:
            return "move", pb.Interaction(object=p["object"], kind="grab", id=self._held, target=target)
        if self._taking:  # it is not known yet whether it holds
            return "status", pb.Interaction()
        self._taking = True
        stiffness = p["force"] / p["reach"]
        return "grab", pb.Interaction(
            object=p["object"], kind="grab", point=place, target=target, stiffness=stiffness, max_force=p["force"]
        )

    def _answered(self, verb: str, reply: pb.Reply | None, sent: float) -> None:
        with self._lock:
            self._open -= 1
            if verb == "grab":
                self._taking = False
                self._held = reply.interaction.id if reply is not None and not reply.error else None
            if reply is None:
                self.counts["unanswered"] += 1
                return
            self.seconds.append(time.monotonic() - sent)
            self.counts["refused" if reply.error else "done"] += 1
            if reply.error:
                self.reasons[re.sub(r"client-\w+|\d[\d.e+-]*", "…", reply.error)] += 1
            if verb == "move" and "has no interaction" in reply.error:
                self._held = None

    def end(self) -> None:
        """Lets go, and waits for what is not answered yet."""
        deadline = time.monotonic() + 4
        while self._open and time.monotonic() < deadline:
            time.sleep(0.01)
        if self._held is not None:
            with contextlib.suppress(BadInput, ClientError):
                self.client.command("release", pb.Interaction(object=self.plan["object"], id=self._held))

    def report(self) -> dict[str, Any]:
        with self._lock:
            return {
                "object": self.plan["object"], "kind": "grab" if self.plan["grabs"] else "push", **self.counts,
                "reply_seconds": list(self.seconds), "reasons": dict(self.reasons.most_common(8)),
            }  # fmt: skip


def drive(hands: list[Hand], seconds: float, ended: threading.Event) -> float:
    """Acts of all hands as they are due, for `seconds` or until told to end; returns how long [s]."""
    begun = time.monotonic()
    due = [(hand.draw.random() / hand.plan["rate"], number) for number, hand in enumerate(hands)]
    heapq.heapify(due)
    while due and not ended.is_set():
        when, number = due[0]
        now = time.monotonic() - begun
        if now >= seconds:
            break
        if when > now:
            ended.wait(min(when - now, seconds - now))
            continue
        hands[number].act(now)
        period = 1 / hands[number].plan["rate"]
        behind = int((now - when) / period) if now - when > 0.1 else 0  # the process does not keep up: leave some out
        hands[number].counts["skipped"] += behind
        heapq.heapreplace(due, (when + (1 + behind) * period, number))
    return time.monotonic() - begun


def _step_back() -> None:
    """Leaves the cores to server and workers. Where Linux schedules by sessions (autogroup), and this is one of its
    own, a nice value counts only within it: the session has one too."""
    os.nice(NICE)
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text(str(NICE))


def main() -> None:
    ended = threading.Event()
    _step_back()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    plan = json.loads(sys.stdin.readline())
    try:
        with ExitStack() as closing:
            hands = [
                Hand(closing.enter_context(Client(plan["server"], plan["connect"])), hand) for hand in plan["hands"]
            ]
            print("ready", flush=True)
            if not sys.stdin.readline():
                return
            seconds = drive(hands, plan["seconds"], ended)
            for hand in hands:
                hand.end()
            print(json.dumps({"seconds": seconds, "clients": [hand.report() for hand in hands]}), flush=True)
    except (BadInput, ClientError) as error:
        print(f"sim-client load: {error}", file=sys.stderr)
        sys.exit(1)
    except BrokenPipeError:  # nobody wants to know any more
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
