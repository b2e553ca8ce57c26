# SPDX-License-Identifier: MIT
"""Checks of received data. Each raises Refused; sizes are checked before anything is allocated."""

import math
import os
from collections.abc import Collection, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any, Protocol, TypeVar

import numpy as np
import xxhash
from google.protobuf.message import DecodeError, Message
from numpy.typing import DTypeLike, NDArray

from protocol.channels import PROTOCOL, check_name
from protocol.messages_pb2 import Header, Topology
from protocol.printable import make_printable
from protocol.refused import Refused

M = TypeVar("M", bound=Message)
CHUNK = 1 << 18  # values checked together, so that temporaries stay in cache
PIECE = 1 << 19  # values that a thread copies at a time
ALONE = 8 << 20  # bytes that a thread copies alone


class Sized(Protocol):
    """Bytes, or a zenoh payload, whose length is known before it is copied."""

    def __len__(self) -> int: ...
    def __bytes__(self) -> bytes: ...


def take(payload: Sized | None, limit: int, what: str) -> bytes:
    """Returns the payload as bytes if it holds at most `limit` bytes."""
    if payload is None:
        raise Refused(f"{what} is missing", "malformed")
    if len(payload) > limit:
        raise Refused(f"{what} has {len(payload)} bytes; allowed: at most {limit}", "size")
    return bytes(payload)


def parse(kind: type[M], payload: Sized | None, limit: int) -> M:
    """Parses a message of at most `limit` bytes and makes its texts printable, for terminals and logs."""
    name = kind.DESCRIPTOR.name
    data = take(payload, limit, name)
    try:
        message = kind.FromString(data)
    except DecodeError as error:
        raise Refused(f"{name} of {len(data)} bytes is not a valid message", "malformed") from error
    make_printable(message)
    return message


def check_header(
    message: Any,
    *,
    incarnation: int | None = None,
    object: str | Collection[str] | None = None,
    epoch: int | None = None,
    after: int | None = None,
) -> Header:
    """Checks the header of a message and returns it. None: not checked.

    object: the name, or the names that are known. after: the last sequence number seen on the channel.
    """
    name = message.DESCRIPTOR.name
    header: Header = message.header
    if header.protocol != PROTOCOL:
        raise Refused(f"{name}.header.protocol is {header.protocol}; allowed: {PROTOCOL}", "version")
    if incarnation is not None and header.incarnation != incarnation:
        raise Refused(
            f"{name}.header.incarnation is {header.incarnation:016x}; allowed: {incarnation:016x}, the server's",
            "incarnation",
        )
    if object is not None:
        check_name(header.object, f"{name}.header.object")
        if header.object not in ([object] if isinstance(object, str) else object):
            allowed = object if isinstance(object, str) else ", ".join(list(object)[:8]) or "none yet"
            raise Refused(f"{name}.header.object is {header.object!r}; allowed: {allowed}", "object")
    if epoch is not None and header.epoch != epoch:
        raise Refused(f"{name}.header.epoch is {header.epoch}; allowed: {epoch}", "epoch")
    if after is not None and header.sequence <= after:
        raise Refused(f"{name}.header.sequence is {header.sequence}; allowed: more than {after}", "sequence")
    return header


def array(data: bytes, dtype: DTypeLike, shape: tuple[int, ...], what: str, *, finite: bool = False) -> NDArray[Any]:
    """Returns a read-only array over `data` (no copy), little-endian, C order; one extent of shape may be -1."""
    kind = np.dtype(dtype).newbyteorder("<")
    known = int(np.prod([n for n in shape if n >= 0], dtype=np.int64)) * kind.itemsize
    fits = (known > 0 and len(data) % known == 0) if -1 in shape else len(data) == known
    if not fits:
        raise Refused(f"{what} has {len(data)} bytes; allowed: {kind.name} of shape {shape}, {known} bytes", "shape")
    values = np.frombuffer(data, kind).reshape(shape)
    if finite and not all_finite(values):
        raise Refused(f"{what} holds NaN or infinite values; allowed: finite", "not_finite")
    return values


def all_finite(values: NDArray[Any]) -> bool:
    """True if no value is NaN or infinite."""
    flat = values.reshape(-1)
    return all(bool(np.isfinite(flat[i : i + CHUNK]).all()) for i in range(0, flat.size, CHUNK))


def copied(source: NDArray[Any], target: NDArray[Any], own: NDArray[Any]) -> tuple[int, bool]:
    """Copies values; returns their `checksum` and `all_finite`. They pass through memory once: pieces stay in cache.

    On a machine with cores to spare other threads copy large arrays meanwhile, and this one sums up behind them.

    source, target: (n,), contiguous, of one type
    own: the one of the two that no other process writes to: what is returned is about its values
    """

    def copy(piece: slice) -> bool:
        np.copyto(target[piece], source[piece])
        return bool(np.isfinite(own[piece]).all())

    large = source.nbytes > ALONE
    helpers, step = (helping_threads(), PIECE) if large else (0, CHUNK)
    pieces = [slice(begin, begin + step) for begin in range(0, source.size, step)]
    digest, finite = xxhash.xxh3_64(), True
    with ExitStack() as closing:
        if helpers:
            pool = closing.enter_context(ThreadPoolExecutor(helpers, "copies"))
            each: Iterable[bool] = pool.map(copy, pieces)
        else:
            each = map(copy, pieces)
        for piece, good in zip(pieces, each, strict=True):
            digest.update(own[piece].view(np.uint8).data)
            finite = finite and good
    return int(digest.intdigest()), finite


def helping_threads() -> int:
    """Number of threads that copy a large array: a quarter of the cores, at most three."""
    return min(3, len(os.sched_getaffinity(0)) // 4)


def check_range(values: NDArray[Any], low: int, high: int, what: str) -> None:
    """Raises Refused unless low <= values < high."""
    if values.size and (int(values.min()) < low or int(values.max()) >= high):
        raise Refused(f"{what} runs from {values.min()} to {values.max()}; allowed: {low} to {high - 1}", "shape")


def check_strings(message: Message, limit: int = 4096) -> None:
    """Raises Refused if a text field of the message is longer than limit characters."""
    for field, value in message.ListFields():
        if isinstance(value, str) and len(value) > limit:
            raise Refused(
                f"{message.DESCRIPTOR.name}.{field.name} has {len(value)} characters; allowed: {limit}", "size"
            )


def check_numbers(message: Message) -> None:
    """Raises Refused if a number in the message, or in messages within it, is NaN or infinite."""
    for field, value in message.ListFields():
        if isinstance(value, float) and not math.isfinite(value):
            raise Refused(f"{message.DESCRIPTOR.name}.{field.name} is {value}; allowed: finite", "not_finite")
        if isinstance(value, Message):
            check_numbers(value)
        elif field.message_type is not None:  # repeated
            for each in value:
                check_numbers(each)


def topology_checksum(topology: Topology) -> int:
    """Returns xxh3_64 of the pattern of the matrix of an object: Topology.row_start and columns."""
    return checksum(topology.row_start + topology.columns)


def checksum(values: NDArray[Any] | bytes) -> int:
    """Returns xxh3_64 of the bytes of a contiguous array."""
    data = values if isinstance(values, bytes) else np.ascontiguousarray(values).reshape(-1).view(np.uint8).data
    return int(xxhash.xxh3_64_intdigest(data))
