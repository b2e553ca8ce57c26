# SPDX-License-Identifier: MIT
"""Orders of elimination on disk: read again only if nobody else can have written them and they are permutations."""

import os

import numpy as np
import pytest

from precond_worker.symbolic import order_cache
from precond_worker.symbolic.order_cache import cached

NODES = 3000
START = np.arange(NODES + 1, dtype=np.int32)
NEIGHBOURS = np.roll(np.arange(NODES, dtype=np.int32), 1)


class Order:
    """An ordering that counts its calls."""

    calls = 0

    def __call__(self, start: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
        self.calls += 1
        return np.arange(len(start) - 1)[::-1]


@pytest.fixture
def kept(tmp_path, monkeypatch):
    monkeypatch.setenv("WARPFACTOR_CACHE", str(tmp_path))
    order = Order()
    cached(order, "a 1", START, NEIGHBOURS)
    (path,) = (tmp_path / "orders").iterdir()
    return order, path


def read(order: Order) -> np.ndarray:
    return cached(order, "a 1", START, NEIGHBOURS)


def test_it_is_made_once_for_each_graph_and_library(kept):
    order, path = kept
    assert np.array_equal(read(order), np.arange(NODES)[::-1]) and order.calls == 1
    assert path.stat().st_mode & 0o777 == 0o600
    cached(order, "a 2", START, NEIGHBOURS)
    cached(order, "a 1", START, NEIGHBOURS[::-1])
    assert order.calls == 3


def test_small_graphs_leave_no_file(kept):
    order, path = kept
    cached(order, "a 1", START[:100], NEIGHBOURS[:99])
    assert order.calls == 2 and len(list(path.parent.iterdir())) == 1


def twice(path):
    values = np.arange(NODES, dtype=np.int32)
    values[5] = 6
    path.write_bytes(values.tobytes())


def beyond(path):
    path.write_bytes(np.arange(1, NODES + 1, dtype=np.int32).tobytes())


def linked(path):
    other = path.with_suffix(".other")
    path.rename(other)
    path.symlink_to(other)


def piped(path):
    path.unlink()
    os.mkfifo(path, 0o600)


@pytest.mark.parametrize(
    "spoil",
    [lambda p: p.write_bytes(p.read_bytes()[:-4]), lambda p: p.write_bytes(b""), twice, beyond, linked,
     piped, lambda p: p.chmod(0o620), lambda p: p.chmod(0o602)],
    ids=["short", "empty", "not a permutation", "out of range", "a link", "a pipe", "group may write", "others may"],
)  # fmt: skip
def test_what_cannot_be_trusted_is_made_anew(kept, spoil):
    order, path = kept
    spoil(path)
    assert np.array_equal(read(order), np.arange(NODES)[::-1])
    assert order.calls == 2
    read(order)
    assert order.calls == 2  # it was written again


def test_a_file_of_another_user_is_not_read(kept, monkeypatch):
    order, _ = kept
    monkeypatch.setattr(os, "geteuid", lambda: 4242)
    read(order)
    assert order.calls == 2


def test_old_files_go_when_there_are_too_many_bytes(kept, monkeypatch):
    order, path = kept
    os.utime(path, (1, 1))
    monkeypatch.setattr(order_cache, "MOST_BYTES", 2 * 4 * NODES)
    for name in ("b", "c"):
        cached(order, name, START, NEIGHBOURS)
    assert not path.exists() and len(list(path.parent.iterdir())) == 2


def test_a_folder_that_cannot_be_written_costs_nothing_but_time(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("WARPFACTOR_CACHE", str(tmp_path / "file"))
    order = Order()
    assert np.array_equal(read(order), read(order)) and order.calls == 2
