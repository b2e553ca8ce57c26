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
        self._loop, self._slot, self.number = loop, slot, 0
        self._own = c.addressof(loop), c.addressof(slot)
        self._kept: list[Any] = []  # mail in use, then mail posted
        self._leaving: list[tuple[int, Any]] = []  # (steps after whose completion it is out of use, mail)

    def post(self, data: bytes, keep: Any = None, event: int | None = None) -> structs.Mail:
        """Replaces the bytes from the next batch on, or from the first one after an event has completed.

        keep: objects that the bytes point to. event: handle of the event.
        The bytes are valid from the step after the result's `taken` steps, once that is not below 0.
        """
        assert len(data) == self._slot.size
        self.number += 1
        memory = c.create_string_buffer(data, len(data))
        mail = structs.Mail(c.addressof(memory), event, self.number, -1)
        displaced = _posting()(*self._own, c.addressof(mail))
        if self._leaving:
            self._leaving = [(step, what) for step, what in self._leaving if step > self._loop.step]
        if displaced:
            self._kept.pop()  # never taken; the mail in use stays
        elif len(self._kept) > 1:  # the last one was taken: those before it are out of use after the steps under way
            self._leaving.append((int(self._loop.launched), self._kept[:-1]))
            del self._kept[:-1]
        self._kept.append((memory, mail, keep))
        return mail

    def withdraw(self) -> bool:
        """Takes back mail that was not copied to the device, while the loop stands still; True if there was any."""
        back = bool(_posting()(*self._own, None))
        back = back or bool(self._slot.pending)
        self._slot.pending = None
        if back:
            self._kept.pop()
        return back

    @property
    def taken(self) -> bool:
        """True if the copy of the last mail to the device has begun."""
        return bool(self._slot.taken == self.number)
