# SPDX-License-Identifier: MIT
"""Device memory that a server shares with a worker beside it: what both know of a slot, and the probe at join (channel
echo).

The worker opens the server's probe slot and looks for a number that the server wrote there; then it writes one itself
and asks the server to read it. The answer is the same for all reasons for which that may fail: another container,
another GPU that cannot be reached, a driver that shares no memory.
"""

import secrets
from typing import Any, Protocol

import numpy as np
import zenoh
from numpy.typing import NDArray

from protocol.channels import PROTOCOL
from protocol.messages_pb2 import DeviceSlot, Echo, Header
from protocol.refused import Refused
from protocol.shared_memory.probe import LANES, NUMBERS, ask

HANDLE = 64  # bytes of a handle
NUMBER = np.dtype(np.uint64)
NOT_OFFERED = "the server offers none"
DEVICE_HEADER = 256  # bytes in front of the data of a slot, of which the first eight are the generation


class OpenedMemory(Protocol):
    """Device memory of a server as a worker opens it. Methods raise Refused."""

    def address(self, slot: DeviceSlot, size: int) -> int:
        """Returns where the data of a slot begin, of which at least `size` bytes are needed."""
        ...

    def is_current(self, slot: DeviceSlot) -> bool:
        """True if the slot was not lent again since the message was sent."""
        ...

    def read(self, address: int, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
        """Copies numbers to the host."""
        ...

    def write(self, address: int, values: NDArray[Any]) -> None:
        """Copies numbers from the host; they are there when it returns."""
        ...

    def clear(self) -> None:
        """Closes all memory, when its server is gone."""
        ...


def obstacle(
    session: zenoh.Session, server: str, incarnation: int, worker: str, memory: OpenedMemory, timeout: float = 2.0
) -> str:
    """Worker: says why it cannot share device memory with this incarnation of the server; empty if it can."""
    lane, nonce = secrets.randbelow(LANES), secrets.randbits(63)
    question = Echo(header=Header(protocol=PROTOCOL, sequence=lane), nonce=nonce, on_device=True)
    try:
        reply, _ = ask(session, server, incarnation, worker, question, timeout)
        if not reply.HasField("device"):
            return NOT_OFFERED
        at = memory.address(reply.device, NUMBER.itemsize * NUMBERS)
        if int(memory.read(at + NUMBER.itemsize * lane, NUMBER, 1)[0]) != nonce or not memory.is_current(reply.device):
            return "what the server wrote is not there"
        memory.write(at + NUMBER.itemsize * (LANES + lane), np.array([nonce ^ 1], NUMBER))
        reply, _ = ask(session, server, incarnation, worker, question, timeout)
        return "" if reply.nonce == nonce ^ 1 else "the server does not see what is written there"
    except (Refused, zenoh.ZError, ValueError) as error:
        return str(error)
