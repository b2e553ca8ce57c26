# SPDX-License-Identifier: MIT
"""Plan of the partitioned inverse (plan.py) on the device, as the kernel reads it (pcg_structs.cuh)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.gpu.cupy_types import DeviceArray
from sim_server.backends.gpu.device import Gpu
from sim_server.backends.gpu.inverse.halves import FarFlags
from sim_server.backends.gpu.inverse.plan import FORM, GATHER, Plan
from sim_server.backends.gpu.structs import PCG

ALIGNMENT = 32  # entries to which the vectors of a body are aligned; 256 bytes
PADDING = 32  # entries behind the packed vectors, to which padding refers

DEVICE_PLAN = PCG.dtype("DevicePlan")


def shared_bytes(plan: Plan, warps: int) -> int:
    """Returns the bytes of shared memory that a thread block of so many warps needs: vector of a phase in two float16,
    sums of tiles that warps share."""
    return 4 * plan.x_area + 128 * warps + 48


def regrouped_by_block(start: NDArray[Any], phases: int, blocks: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Reorders lists from [phase, block] to [block, phase]; returns the new starts and the old index of each item."""
    order = np.arange(phases * blocks).reshape(phases, blocks).T.ravel()
    start = start.astype(np.int64)
    length = np.diff(start)[order]
    new = np.concatenate([[0], np.cumsum(length)])
    items = np.arange(new[-1]) - np.repeat(new[:-1] - start[:-1][order], length)
    return new, items


def warp_segments(plan: Plan) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Cuts segments into 32 entries each; returns starts of the lists, and (kind, from, to, 2 valid + keep)."""
    segments = plan.segments.astype(np.int64)
    count = segments[:, 2] // 32
    ends = np.concatenate([[0], np.cumsum(count)])
    which = np.repeat(np.arange(len(segments)), count)
    step = 32 * (np.arange(ends[-1]) - ends[:-1][which])
    kind, begin, to = segments[which, 0], segments[which, 1] + step, segments[which, 3] + step
    used = np.zeros((2, max(len(plan.boundary), plan.size) // 32), np.int64)  # entries that are not padding, of 32
    used[0, : plan.size // 32] = (plan.column.reshape(-1, 32) >= 0).sum(axis=1)
    used[1, : len(plan.boundary) // 32] = (plan.boundary.reshape(-1, 32) < plan.size).sum(axis=1)
    valid = used[(kind & 3) // 2, begin // 32]
    return ends[plan.segment_start], np.stack([kind & 3, begin, to, 2 * valid + (kind >> 2 & 1)], 1).astype(np.int32)


def entry_index(plan: Plan, cut: NDArray[np.int32]) -> NDArray[np.int32]:
    """Returns the position of each entry, or its range of contributions (first | number << 24), (segments, 32).

    Raises ValueError if there are too many contributions.
    """
    start = plan.slot_start
    many = np.diff(start)
    if len(many) and (many.max() > 255 or start[-1] >= 1 << 24):
        raise ValueError(
            f"FactorPattern: {start[-1]} couplings of parts, {many.max()} to a row; "
            f"allowed on a GPU: {(1 << 24) - 1}, 255"
        )
    entry = np.add.outer(cut[:, 1], np.arange(32, dtype=np.int32)).astype(np.int32, copy=False)
    for kind, table in ((FORM, start[:-1] | many << 24), (GATHER, plan.boundary)):
        chosen = np.flatnonzero(cut[:, 0] == kind)
        if len(chosen):
            entry[chosen] = table[entry[chosen]]
    return entry


def paired_tiles(tiles: NDArray[Any], start: NDArray[Any], planes: int) -> tuple[NDArray[np.int32], NDArray[np.int64]]:
    """Joins tiles of 8 rows with the next 8 rows where they follow, (k, 8): chunk, x, chunks, out, rows, 0,
    chunks of the tiles before it in its list, 0."""
    chunk, x, chunks, out = tiles.T.astype(np.int64)
    follows = np.zeros(len(tiles), bool)  # the one before, in the same list
    follows[1:] = (x[1:] == x[:-1]) & (out[1:] == out[:-1] + 8) & (chunk[1:] == chunk[:-1] + planes * chunks[:-1])
    follows[start[:-1][start[:-1] < len(tiles)]] = False
    run = np.maximum.accumulate(np.where(follows, 0, np.arange(len(tiles))))
    second = (np.arange(len(tiles)) - run) % 2 == 1
    found = np.zeros((len(tiles), 8), np.int32)
    found[:, :4] = tiles
    found[:, 4] = 8 + 8 * np.append(second[1:], False)
    kept = np.concatenate([[0], np.cumsum(~second)])
    found, start = found[~second], kept[start]
    total = np.concatenate([[0], np.cumsum(found[:, 2])])
    found[:, 6] = total[:-1] - np.repeat(total[start[:-1]], np.diff(start))
    return found, start


def block_ranges(segment_start: NDArray[Any], tile_start: NDArray[Any], plan: Plan) -> NDArray[np.int64]:
    """Returns first and number of the segments, tiles and chunks of each thread block, (blocks, 8)."""
    found = np.zeros((plan.blocks, 8), np.int64)
    for k, start in enumerate((segment_start[:: plan.phases], tile_start[:: plan.phases], plan.chunk_start)):
        found[:, 2 * k], found[:, 2 * k + 1] = start[:-1], np.diff(start)
    return found


def phase_lists(
    segment_start: NDArray[Any], tile_start: NDArray[Any], formed: NDArray[Any], plan: Plan
) -> NDArray[np.int64]:
    """Returns the lists of each thread block, (blocks, 3 phases + 2): starts of the segments of each phase and of its
    tiles, within the block; first segment that is not formed.

    formed (segments,): True for segments that the block forms; they come first in a phase.
    """
    blocks, phases = plan.blocks, plan.phases
    at = phases * np.arange(blocks)[:, None] + np.arange(phases + 1)
    own = [start[at] - start[at[:, :1]] for start in (segment_start, tile_start)]
    total = np.concatenate([[0], np.cumsum(formed)])[segment_start]
    return np.hstack([*own, own[0][:, :-1] + np.diff(total[at], axis=1)])


class DevicePlan:
    """A plan on the device.

    device: thread blocks before `first` are on device 0, the others on device 1, and this is the plan of one of these
        (halves.py); None: for a solver without another device
    address: of the struct DevicePlan (pcg_structs.cuh)
    bytes: of the matrices
    """

    def __init__(self, gpu: Gpu, plan: Plan, device: int | None = None, first: int = 0):
        self.gpu, self.plan = gpu, plan
        self.bytes = int(plan.chunks) * 512
        segment_start, cut = warp_segments(plan)
        segment_start, segment_order = regrouped_by_block(segment_start, plan.phases, plan.blocks)
        tile_start, tile_order = regrouped_by_block(plan.tile_start, plan.phases, plan.blocks)
        tiles, tile_start = paired_tiles(plan.tiles[tile_order], tile_start, plan.planes)
        target = np.full(plan.contributions + PADDING, len(plan.slots), np.int32)
        target[plan.slots] = np.arange(len(plan.slots), dtype=np.int32)
        self._contributions = len(plan.slots) + PADDING
        arrays: dict[str, NDArray[Any]] = {
            "block_ranges": block_ranges(segment_start, tile_start, plan),
            "lists": phase_lists(segment_start, tile_start, cut[segment_order, 0] == 0, plan),
            "segments": cut[segment_order], "index": entry_index(plan, cut[segment_order]), "tiles": tiles,
            "target": target, "place": plan.place,
        }  # fmt: skip
        if device is not None:
            far = FarFlags(plan, first, device)
            phase = np.repeat(np.arange(plan.blocks * plan.phases) % plan.phases, np.diff(tile_start))
            target[plan.slots] |= far.contributions()
            arrays["segments"][:, 0] |= far.segments(arrays["segments"])
            tiles[:, 5] = far.tiles(tiles, phase)
            arrays["place"] = plan.place | far.places()
        self.arrays = {name: gpu.cp.asarray(array.astype(np.int32, copy=False)) for name, array in arrays.items()}
        params = np.zeros((), DEVICE_PLAN)
        params["phases"], params["blocks"], params["groups"] = plan.phases, plan.blocks, plan.groups
        params["size"], params["entries"] = plan.size, plan.x_area
        params["contributions"] = self._contributions
        for name, array in self.arrays.items():
            params[name] = array.data.ptr
        self._params = gpu.cp.asarray(params.reshape(1).view(np.uint8))
        self.address = int(self._params.data.ptr)

    def vectors(self) -> dict[str, DeviceArray]:
        """Allocates the vectors of one body, as flag words (block_group.cuh) with exchange number 0, all at once."""
        sizes = self.vector_sizes()
        ends = np.cumsum([-(-size // ALIGNMENT) * ALIGNMENT for size in sizes.values()]).tolist()
        memory, begins = self.gpu.cp.zeros(ends[-1]), [0, *ends[:-1]]
        return {name: memory[begin : begin + sizes[name]] for name, begin in zip(sizes, begins, strict=True)}

    def vector_sizes(self) -> dict[str, int]:
        """Returns the words of each of these vectors."""
        n = self.plan.size + PADDING
        return {
            "residual": 2 * n, "product": n, "z": n, "formed": n, "solved": n, "contributed": self._contributions,
        }  # fmt: skip
