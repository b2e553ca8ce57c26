# SPDX-License-Identifier: MIT
"""The compiled GPU loop (loop.cpp) and its mailboxes."""

import ctypes as c
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.compiler import native
from sim_server.backends.gpu import structs

MAIL = structs.LOOP.dtype("Mail")


@cache
def library() -> c.CDLL:
    """Compiles and loads loop.cpp. Raises RuntimeError if a struct has another size there."""
    loop, p = c.POINTER(structs.GpuLoop), c.c_void_p
    compiled = native(
        "backends/gpu/loop.cpp",
        {
            "wf_gpu_run": (c.c_int64, [loop, c.c_int64]), "wf_gpu_wait": (c.c_int32, [loop]),
            "wf_gpu_open": (c.c_int32, [loop]), "wf_gpu_renew": (c.c_int32, [loop]),
            "wf_gpu_close": (c.c_int32, [loop]), "wf_gpu_post": (p, [loop, c.POINTER(structs.MailSlot), p]),
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
    held.restype, held.argtypes = c.c_void_p, [c.c_void_p, c.c_void_p, c.c_void_p]
    return held


@cache
def _posting_all() -> Any:
    """Likewise, into several mailboxes."""
    held = c.PyDLL(library()._name).wf_gpu_post_all
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

    def __init__(self, loop: structs.GpuLoop, slot: structs.MailSlot):
        self.loop, self._slot, self.number = loop, slot, 0
        self._own = _, self.address = c.addressof(loop), c.addressof(slot)
        self.size = int(slot.size)
        self._used: Any = None  # mail in use
        self._waiting: Any = None  # mail posted, which may be in use since
        self._leaving: list[tuple[int, Any]] = []  # (steps after whose completion it is out of use, mail)

    def post(self, data: bytes, keep: Any = None, event: int | None = None) -> structs.Mail:
        """Replaces the bytes from the next batch on, or from the first one after an event has completed.

        keep: objects that the bytes point to. event: handle of the event.
        The bytes are valid from the step after the result's `taken` steps, once that is not below 0.
        """
        assert len(data) == self.size
        self.number += 1
        memory = c.create_string_buffer(data, len(data))
        mail = structs.Mail(c.addressof(memory), event, self.number, -1)
        displaced = bool(_posting()(*self._own, c.addressof(mail)))
        self.note(displaced, (memory, mail, keep), self.loop.step, self.loop.launched)
        return mail

    def note(self, displaced: bool, kept: Any, step: int, launched: int) -> None:
        """Keeps what was posted last.

        displaced: what was posted before was not taken
        step, launched: steps completed, and launched
        """
        if self._leaving:
            self._leaving = [each for each in self._leaving if each[0] > step]
        if not displaced and self._waiting is not None:  # it was taken: what was used before leaves after those steps
            if self._used is not None:
                self._leaving.append((launched, self._used))
            self._used = self._waiting
        self._waiting = kept

    def withdraw(self) -> bool:
        """Takes back mail that was not copied to the device, while the loop stands still; True if there was any."""
        back = bool(_posting()(*self._own, None))
        back = back or bool(self._slot.pending)
        self._slot.pending = None
        if back:
            self._waiting = None
        return back

    @property
    def taken(self) -> bool:
        """True if the copy of the last mail to the device has begun."""
        return bool(self._slot.taken == self.number)


def post_all(
    boxes: Sequence[DeviceMailbox], data: NDArray[np.uint8], keep: Sequence[Any], events: Sequence[int]
) -> list[structs.Mail]:  # fmt: skip
    """Posts into different mailboxes of one loop, as DeviceMailbox.post does into each, by one call of native code.

    data: bytes of each, (boxes, bytes)
    """
    count, data, loop = len(boxes), np.ascontiguousarray(data), boxes[0].loop
    assert data.shape == (count, boxes[0].size)
    memory: Any = (structs.Mail * count)()
    displaced = np.empty(count, np.bool_)
    for box in boxes:
        box.number += 1
    table: NDArray[Any] = np.frombuffer(memory, MAIL)
    table["bytes"], table["event"] = data.ctypes.data + data.shape[1] * np.arange(count), events
    table["number"], table["taken"] = [box.number for box in boxes], -1
    slots = np.array([box.address for box in boxes], np.uintp)
    own = c.addressof(loop), count, slots.ctypes.data, c.addressof(memory), displaced.ctypes.data
    _posting_all()(*own)
    mails, step, launched = list(memory), loop.step, loop.launched
    for box, mail, kept, displaces in zip(boxes, mails, keep, displaced.tolist(), strict=True):
        box.note(displaces, (data, mail, kept), step, launched)
    return mails
