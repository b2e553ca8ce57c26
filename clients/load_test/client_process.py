# SPDX-License-Identifier: MIT
"""A process with several clients of a load test: half of them push, half grab and move, each at its rate.

Started by processes.py. It reads a plan as one line of JSON from stdin, writes "ready" to stdout once all clients are
connected, waits for a line on stdin to begin, and at the end writes its report as JSON to stdout. Commands are sent
when they are due, whether or not the last one was answered.
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

MAX_UNANSWERED = 256  # commands of one client; beyond that it skips
MAX_REPLY_TIMES = 20_000  # kept of a client
PUSH = 0.1  # s of simulation
NICE = 10  # priority given up, as the server is measured and not its clients
CIRCLE = 0.5  # turns a second of the target of a grab


class LoadClient:
    """A simulated user. plan: object, at [m], force [N], reach [m], rate [1/s], grabs, seed."""

    def __init__(self, client: Client, plan: dict[str, Any]):
        self.client, self.plan = client, plan
        self.draw = random.Random(plan["seed"])
        self.counts: Counter[str] = Counter(sent=0, done=0, refused=0, unanswered=0, skipped=0)
        self.reasons: Counter[str] = Counter()
        self.seconds: deque[float] = deque(maxlen=MAX_REPLY_TIMES)
        self._open, self._lock = 0, threading.Lock()
        self._held: int | None = None  # id of the grab
        self._grabbing = False

    def act(self, now: float) -> None:
        """Sends the next command: a push, the grab, or the next target of the grab."""
        with self._lock:
            if self._open >= MAX_UNANSWERED:
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
            direction = [self.draw.gauss(0, 1) for _ in range(3)]
            size = p["force"] * self.draw.uniform(0.2, 1.0) / max(math.hypot(*direction), 1e-9)
            force = vector([size * w for w in direction], "force")
            return "push", pb.Interaction(object=p["object"], kind="push", point=place, force=force, duration=PUSH)
        angle = 2 * math.pi * CIRCLE * now
        x, y, z = p["at"]
        target = vector([x + p["reach"] * math.sin(angle), y + p["reach"] * (math.cos(angle) - 1), z], "target")
        if self._held is not None:
            return "move", pb.Interaction(object=p["object"], kind="grab", id=self._held, target=target)
        if self._grabbing:  # the reply to the grab has not come yet
            return "status", pb.Interaction()
        self._grabbing = True
        stiffness = p["force"] / p["reach"]
        return "grab", pb.Interaction(
            object=p["object"], kind="grab", point=place, target=target, stiffness=stiffness, max_force=p["force"]
        )

    def _answered(self, verb: str, reply: pb.Reply | None, sent: float) -> None:
        with self._lock:
            self._open -= 1
            if verb == "grab":
                self._grabbing = False
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
        """Waits for the replies that are missing, and releases the grab."""
        deadline = time.monotonic() + 4
        while self._open and time.monotonic() < deadline:
            time.sleep(0.01)
        if self._held is not None:
            with contextlib.suppress(BadInput, ClientError):
                self.client.command("release", pb.Interaction(object=self.plan["object"], id=self._held))

    def report(self) -> dict[str, Any]:
        """Counts of commands, reply times [s] and reasons of refusals, for JSON."""
        with self._lock:
            return {
                "object": self.plan["object"], "kind": "grab" if self.plan["grabs"] else "push", **self.counts,
                "reply_seconds": list(self.seconds), "reasons": dict(self.reasons.most_common(8)),
            }  # fmt: skip


def drive(clients: list[LoadClient], seconds: float, ended: threading.Event) -> float:
    """Sends the commands of all clients as they are due, for `seconds` or until `ended`; returns the time [s]."""
    begun = time.monotonic()
    due = [(client.draw.random() / client.plan["rate"], number) for number, client in enumerate(clients)]
    heapq.heapify(due)
    while due and not ended.is_set():
        when, number = due[0]
        now = time.monotonic() - begun
        if now >= seconds:
            break
        if when > now:
            ended.wait(min(when - now, seconds - now))
            continue
        clients[number].act(now)
        period = 1 / clients[number].plan["rate"]
        behind = int((now - when) / period) if now - when > 0.1 else 0  # the process does not keep up and skips some
        clients[number].counts["skipped"] += behind
        heapq.heapreplace(due, (when + (1 + behind) * period, number))
    return time.monotonic() - begun


def _lower_priority() -> None:
    """Gives server and workers precedence on the cores.

    Where Linux schedules by sessions (autogroup), the nice value of a process counts only within its session, so that
    the session gets one, too.
    """
    os.nice(NICE)
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text(str(NICE))


def main() -> None:
    ended = threading.Event()
    _lower_priority()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    plan = json.loads(sys.stdin.readline())
    try:
        with ExitStack() as closing:
            clients = [
                LoadClient(closing.enter_context(Client(plan["server"], plan["connect"])), one)
                for one in plan["clients"]
            ]
            print("ready", flush=True)
            if not sys.stdin.readline():
                return
            seconds = drive(clients, plan["seconds"], ended)
            for client in clients:
                client.end()
            print(json.dumps({"seconds": seconds, "clients": [client.report() for client in clients]}), flush=True)
    except (BadInput, ClientError) as error:
        print(f"sim-client load: {error}", file=sys.stderr)
        sys.exit(1)
    except BrokenPipeError:  # the parent has ended
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)


if __name__ == "__main__":
    main()
