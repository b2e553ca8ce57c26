# SPDX-License-Identifier: MIT
"""Storages of the inverses of all bodies, and which of them steps read, by columns.

A body has storages of up to MAX_KINDS kinds of inverses, two of each (double buffering): place 2 k + i is storage i of
its kind k. One that steps read is not written.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int64
from sim_server.backends.gpu.cupy_types import Event
from sim_server.backends.gpu.inverse.build_inverse import InverseStorage
from sim_server.backends.gpu.mailbox import Mailboxes

MAX_KINDS = 2  # of inverses of a body at a time; workers with different libraries send different patterns
NONE = -1
InverseKind = tuple[int, int]
"""Of inverses: id of the pattern, float16 numbers per entry."""


class BodyInverses:
    """Which inverses bodies have. For one thread at a time; rows of bodies of which one is being built do not change.

    mailboxes: into which they are posted, one per body
    """

    def __init__(self, mailboxes: Mailboxes):
        self._mailboxes, count = mailboxes, len(mailboxes)
        self._patterns = [np.zeros(count, np.uint64) for _ in range(MAX_KINDS)]  # of each kind
        self._planes = [np.zeros(count, np.int64) for _ in range(MAX_KINDS)]  # 0: the body has no such kind
        self._storages: list[list[InverseStorage | None]] = [[None] * (2 * MAX_KINDS) for _ in range(count)]
        self._used, self._posted = np.full(count, NONE), np.full(count, NONE)  # places; posted: not taken up yet
        self._used_steps, self._posted_steps = np.full(count, NONE), np.full(count, NONE)  # of their matrices
        self._events: list[Event | None] = [None] * count  # of what was posted last
        self._leaves = np.full(count, NONE)  # steps after whose completion none reads the inverse in use before
        self._expected: dict[int, int] = {}  # by body, id of the pattern that its factors will have

    def expect(self, body: int, pattern: int) -> None:
        """Takes note of the pattern that the factors of a body will have, until one of a new pattern comes."""
        self._expected[body] = pattern

    def refresh(self, bodies: Int64, step: int) -> None:
        """Takes note of what the loop has taken up, and of what no step reads any more. step: steps completed"""
        posted = bodies[self._posted[bodies] != NONE]
        taken = posted[self._mailboxes.taken(posted)]
        if len(taken):
            before = taken[self._used[taken] != NONE]  # steps launched until then may still read those
            self._leaves[before] = self._mailboxes.after(before)
            self._used[taken], self._used_steps[taken] = self._posted[taken], self._posted_steps[taken]
            self._posted[taken] = NONE
        leaves = self._leaves[bodies]
        self._leaves[bodies[(leaves != NONE) & (leaves <= step)]] = NONE

    def free(self, bodies: Int64) -> NDArray[np.bool_]:
        """Returns of which bodies a storage is free, or will be made: one that no step reads, or is about to read."""
        free: NDArray[np.bool_] = (self._posted[bodies] == NONE) & (self._leaves[bodies] == NONE)
        return free

    def step(self, body: int) -> int:
        """Returns the step of the matrix of the inverse in use, -1 without one."""
        return int(self._used_steps[body])

    def has_any(self, body: int) -> bool:
        """True if a body uses an inverse."""
        return bool(self._used[body] != NONE)

    def _spare_places(self, bodies: Int64, kind: InverseKind) -> Int64:
        """Returns the place of an inverse of this kind that no step reads; -1: the body has no such kind."""
        (pattern, planes), used, found = kind, self._used[bodies], np.full(len(bodies), NONE)
        for number in range(MAX_KINDS):  # arrays of one dimension: indexing others lets go of Python's lock
            alike = (self._patterns[number][bodies] == np.uint64(pattern)) & (self._planes[number][bodies] == planes)
            found = np.where(alike, 2 * number + (used == 2 * number), found)
            if alike.all():
                break
        return found

    def spare(self, bodies: Int64, kind: InverseKind) -> list[InverseStorage | None]:
        """Returns a storage of this kind of each body that no step reads, if there is one; only where one is free."""
        places, storages = self._spare_places(bodies, kind).tolist(), self._storages
        return [
            None if place == NONE else storages[body][place]
            for body, place in zip(bodies.tolist(), places, strict=True)
        ]

    def keep(self, bodies: Int64, kind: InverseKind, storages: Sequence[InverseStorage], event: Event) -> bool:
        """Keeps new storages of bodies, and gives up those of kinds that are not used any more. Returns True if there
        was such a kind. event: after it the inverses in the new ones are complete"""
        new = bodies[self._spare_places(bodies, kind) == NONE]
        outdated = bool(len(new)) and self._make_room(new, kind, event)
        places = self._spare_places(bodies, kind).tolist()
        for body, place, storage in zip(bodies.tolist(), places, storages, strict=True):
            self._storages[body][place] = storage
        return outdated

    def _make_room(self, bodies: Int64, kind: InverseKind, event: Event) -> bool:
        """Gives bodies another kind, in the place of one that is not in use where there is no room."""
        there = np.stack([planes[bodies] != 0 for planes in self._planes], axis=1)
        in_use = np.arange(MAX_KINDS) == (self._used[bodies] // 2)[:, None]
        chosen = (there.astype(int) + in_use).argmin(axis=1)
        given_up = there[np.arange(len(bodies)), chosen]
        if given_up.any():
            event.synchronize()  # a build before it, of one that was dropped, may write there
        for body, slot, full in zip(bodies.tolist(), chosen.tolist(), given_up.tolist(), strict=True):
            if full:
                self._storages[body][2 * slot : 2 * slot + 2] = [None, None]
            self._patterns[slot][body], self._planes[slot][body] = kind
            self._expected.pop(body, None)
        return bool((there & ~in_use).any())

    def post(self, bodies: Int64, kind: InverseKind, steps: Sequence[int], event: Event) -> None:
        """Takes note that inverses in spare storages are posted. steps: of their matrices. event: after it they are
        complete"""
        self._posted[bodies], self._posted_steps[bodies] = self._spare_places(bodies, kind), steps
        for body in bodies.tolist():
            self._events[body] = event

    def posted(self, body: int) -> Event | None:
        """Returns the event of an inverse that is posted and, as last seen, not taken up by the loop."""
        return None if self._posted[body] == NONE else self._events[body]

    def take_back(self, body: int) -> None:
        """Takes back what is posted for a body and not taken up, while the loop stands still."""
        event = self.posted(body)
        if event is not None and self._mailboxes.withdraw(body):
            event.synchronize()  # its storage may be reused
            self._posted[body] = NONE

    def at_rest(self, body: int) -> None:
        """Takes note that no step under way reads the inverse that was in use before: the loop stands still."""
        self._leaves[body] = NONE

    def kinds(self) -> set[InverseKind]:
        """Returns the kinds that bodies have, or will have as far as it is known."""
        found = {
            kind
            for patterns, planes in zip(self._patterns, self._planes, strict=True)
            for kind in zip(patterns.tolist(), planes.tolist(), strict=True)
            if kind[1]
        }
        return found | {(pattern, planes) for pattern in self._expected.values() for planes in (1, 2)}
