# SPDX-License-Identifier: MIT
"""A process that opens device memory of another one. Arguments: handle, capacity, generation, and what it does:

fill VALUE: writes it to the first 1000 floats again and again, and says so after the first time
open: opens and reads it
try: tells what is refused of it
"""

import sys
from typing import Any

import numpy as np

from precond_worker.gpu.opened_memory import OpenedDeviceMemory
from protocol.messages_pb2 import DeviceSlot
from protocol.refused import Refused

COUNT = 1000


def refused(memory: OpenedDeviceMemory, slot: DeviceSlot, size: int) -> str:
    try:
        memory.address(slot, size)
    except Refused as refusal:
        return f"{refusal.kind}: {refusal}"
    return "opened"


def main() -> None:
    told, capacity, generation, what, *more = sys.argv[1:]
    memory, handle = OpenedDeviceMemory(), bytes.fromhex(told)
    slot = DeviceSlot(handle=handle, capacity=int(capacity), generation=int(generation))
    if what == "try":
        for changed, size in (
            (DeviceSlot(handle=handle[:-1], capacity=64), 64),
            (DeviceSlot(handle=handle[::-1], capacity=64), 64),
            (DeviceSlot(handle=bytes(64), capacity=64), 64),
            (DeviceSlot(handle=handle, capacity=slot.capacity + (1 << 32)), 64),
            (slot, slot.capacity + 1),
            (slot, slot.capacity),
        ):
            print(refused(memory, changed, size), flush=True)
        return
    at: Any = memory.address(slot, 4 * COUNT)
    print(memory.is_current(slot), memory.read(at, np.dtype(np.float32), COUNT).tolist()[0], flush=True)
    if what == "fill":
        values, said = np.full(COUNT, float(more[0]), np.float32), False
        while True:
            memory.write(at, values)
            if not said:
                print("written", flush=True)
                said = True


if __name__ == "__main__":
    main()
