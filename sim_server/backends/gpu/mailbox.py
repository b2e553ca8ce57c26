# SPDX-License-Identifier: MIT
"""The compiled GPU loop (loop.cpp) and its mailboxes."""

import ctypes as c
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int64
from sim_server.backends.compiler import native
from sim_server.backends.gpu import structs
from sim_server.backends.gpu.cupy_types import Event

MAIL, SLOT = structs.LOOP.dtype("Mail"), structs.LOOP.dtype("MailSlot")


@cache
def library() -> c.CDLL:
    """Compiles and loads loop.cpp. Raises RuntimeError if a struct has another size there."""
    loop, p = c.POINTER(structs.GpuLoop), c.c_void_p
    compiled = native(
        "backends/gpu/loop.cpp",
        {
            "wf_gpu_run": (c.c_int64, [loop, c.c_int64]), "wf_gpu_wait": (c.c_int32, [loop]),
            "wf_gpu_open": (c.c_int32, [loop]), "wf_gpu_renew": (c.c_int32, [loop]),
            "wf_gpu_close": (c.c_int32, [loop]), "wf_gpu_post": (None, [loop, c.c_int64, p, p, p]),
            "wf_launch_build": (c.c_int32, [c.POINTER(structs.CudaDriver), c.POINTER(structs.BuildLaunch)]),
            "wf_gpu_post_changes": (p, [loop, p]), "wf_gpu_take_changes": (c.c_int32, [loop]),
            "wf_gpu_start_balances": (None, [c.c_int64, *[p] * 6, c.c_int32, p, c.c_double, c.c_int32]),
        },
    )  # fmt: skip
    structs.LOOP.check_sizes(compiled)
    return compiled


@cache
def _posting() -> Any:
    """The function that posts mail. It keeps Python's lock, which takes longer to get back than to post."""
    held = c.PyDLL(library()._name).wf_gpu_post
    held.restype, held.argtypes = None, [c.c_void_p, c.c_int64, *[c.c_void_p] * 3]
    return held


class ChangeMailbox:
    """Has the loop copy new contents into arrays on the device, all between the same two batches.

    Keeps their memory until no step under way copies it.
    """

    def __init__(self, loop: structs.GpuLoop):
        self._loop = loop
        self._kept: list[tuple[structs.DeviceChanges, Any]] = []

    def post(
        self, copies: Sequence[tuple[int, int, int]], before: int, after: int, keep: Any = None,
        places: NDArray[np.int64] | None = None,
    ) -> structs.DeviceChanges:  # fmt: skip
        """Posts copies: device addresses of target and source, and bytes. Nothing else may wait (`withdraw`).

        before, after: handles of graphs that are launched around them. keep: objects that own the memory.
        places: (bodies, 2), where the blocks of each body begin among the values of A from then on, and their bytes;
        None: as before.
        The contents are valid from the step after the result's `taken` steps, once that is not below 0.
        """
        native = (structs.DeviceCopy * max(len(copies), 1))(*(structs.DeviceCopy(*each) for each in copies))
        at = None if places is None else places.ctypes.data
        made = structs.DeviceChanges(
            copies=c.addressof(native), places=at, before=before, after=after, count=len(copies), taken=-1
        )
        self._kept = [each for each in self._kept if not 0 <= each[0].taken < self._loop.step]
        self._kept.append((made, (native, places, keep)))
        library().wf_gpu_post_changes(c.byref(self._loop), c.addressof(made))
        return made

    def withdraw(self) -> bool:
        """Takes back what the loop has not begun to copy; True if there was anything."""
        back = bool(library().wf_gpu_post_changes(c.byref(self._loop), None))
        if back:
            self._kept.pop()
        return back


class DeviceMailbox:
    """Replaces bytes on the device between batches (structs.MailSlot).

    Keeps mail, and what its bytes point to, until no step under way uses it.
    """

    def __init__(self, loop: structs.GpuLoop, slot: structs.MailSlot, place: int):
        """place: number of the slot among those of the loop."""
        self._loop, self._slot, self.number = loop, slot, 0
        self._place, self._displaced = c.c_int64(place), c.c_uint8()
        self._own = c.addressof(loop), 1, c.addressof(self._place)
        self._size = int(slot.size)
        self._used: Any = None  # mail in use
        self._waiting: Any = None  # mail posted, which may be in use since
        self._leaving: list[tuple[int, Any]] = []  # (steps after whose completion it is out of use, mail)

    def post(self, data: bytes, keep: Any = None, event: int | None = None) -> structs.Mail:
        """Replaces the bytes from the next batch on, or from the first one after an event has completed.

        keep: objects that the bytes point to. event: handle of the event.
        The bytes are valid from the step after the result's `taken` steps, once that is not below 0.
        """
        assert len(data) == self._size
        self.number += 1
        memory = c.create_string_buffer(data, len(data))
        mail = structs.Mail(c.addressof(memory), event, self.number, -1)
        displaced, step = self._exchange(mail), self._loop.step
        self._leaving = [each for each in self._leaving if each[0] > step]
        if not displaced and self._waiting is not None:  # it was taken: what was used before leaves after those steps
            if self._used is not None:
                self._leaving.append((self._loop.launched, self._used))
            self._used = self._waiting
        self._waiting = (memory, mail, keep)
        return mail

    def _exchange(self, mail: structs.Mail | None) -> bool:
        """Posts mail in place of what was posted before; True if that was not taken."""
        _posting()(*self._own, None if mail is None else c.addressof(mail), c.addressof(self._displaced))
        return bool(self._displaced.value)

    def withdraw(self) -> bool:
        """Takes back mail that was not copied to the device, while the loop stands still; True if there was any."""
        back = self._exchange(None) or bool(self._slot.pending)
        self._slot.pending = None
        if back:
            self._waiting = None
        return back

    @property
    def taken(self) -> bool:
        """True if the copy of the last mail to the device has begun."""
        return bool(self._slot.taken == self.number)


class Mailboxes:
    """A row of mailboxes, one per body, into which mail for many bodies is posted at a time.

    Mail for a body is posted once that before it was taken or withdrawn, except for the second one.
    """

    def __init__(self, loop: structs.GpuLoop, slots: Any, first: int, count: int):
        """slots: array of structs.MailSlot, all of the loop. first, count: those of this row"""
        self._loop, self._first, self._count = loop, first, count
        self._slots: NDArray[Any] = np.frombuffer(slots, SLOT)[first : first + count]
        self._numbers = np.zeros(count, np.int64)  # of the mail posted last
        self._kept: list[list[Any]] = [[None] * count, [None] * count]  # of the last mail and of that before it

    def __len__(self) -> int:
        return self._count

    def post(self, bodies: Int64, data: NDArray[np.uint8], event: Event | None = None, keep: Any = None) -> None:
        """Replaces the bytes of different bodies from the next batch on, or from the first one after an event has
        completed. data: of each, (bodies, bytes). keep: objects that they point to"""
        count, data = len(bodies), np.ascontiguousarray(data)
        assert data.shape == (count, self._slots["size"][0])
        self._numbers[bodies] += 1
        mail = np.zeros(count, MAIL)
        mail["bytes"], mail["event"] = data.ctypes.data + data.shape[1] * np.arange(count), event.ptr if event else 0
        mail["number"], mail["taken"] = self._numbers[bodies], -1
        (last, before), kept = self._kept, (data, mail, event, keep)
        for body in bodies.tolist():
            before[body], last[body] = last[body], kept
        self._exchange(bodies, mail.ctypes.data)

    def _exchange(self, bodies: Int64, mail: int | None) -> NDArray[np.bool_]:
        """Posts mail, from this address on, in place of what was posted before; returns where that was not taken."""
        places, displaced = bodies + self._first, np.empty(len(bodies), np.bool_)
        _posting()(c.addressof(self._loop), len(bodies), places.ctypes.data, mail, displaced.ctypes.data)
        return displaced

    def withdraw(self, body: int) -> bool:
        """Takes back mail that was not copied to the device, while the loop stands still; True if there was any."""
        slot = self._slots[body]
        back = bool(self._exchange(np.array([body]), None)[0]) or bool(slot["pending"])
        slot["pending"] = 0
        return back

    def taken(self, bodies: Int64) -> NDArray[np.bool_]:
        """Returns of which bodies the copy of the last mail to the device has begun."""
        found: NDArray[np.bool_] = self._slots["taken"][bodies] == self._numbers[bodies]
        return found

    def after(self, bodies: Int64) -> Int64:
        """Returns the steps launched before the last mail of bodies was copied: it is valid for those after."""
        found: Int64 = self._slots["after"][bodies]
        return found
