# SPDX-License-Identifier: MIT
"""Many arrays that are copied and checked in one call."""

import ctypes
import subprocess
import sys

import numpy as np
import pytest

from protocol.shared_memory import copies as module
from protocol.shared_memory.copies import SOURCE, Copies, Parts
from protocol.validate import ALONE, checksum
from sim_server.backends.compiler import build

SIZES = (0, 1, 3, 60, 61, 4096, 70_001)


@pytest.fixture(scope="module", params=["native", "NumPy"])
def made(request):
    return Copies(ctypes.CDLL(str(build(SOURCE, stepping=False))) if request.param == "native" else None)


def arrays(dtype, sizes=SIZES):
    rng = np.random.default_rng(1)
    return [rng.standard_normal(size).astype(dtype) for size in sizes]


def test_native_code_has_the_checksum_of_the_package():
    assert module.hash_address() is not None  # else every copy of this suite went by NumPy


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_copies_have_the_checksums_of_their_values(made, dtype):
    sources = arrays(dtype)
    targets = [np.full_like(each, np.nan) for each in sources]
    assert made.copy(sources, targets) == [checksum(each) for each in sources]
    for source, target in zip(sources, targets, strict=True):
        np.testing.assert_array_equal(target, source)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("bad", [np.nan, -np.nan, np.inf, -np.inf])
def test_numbers_that_are_not_finite_are_found_in_their_array_alone(made, dtype, bad):
    sources = arrays(dtype, SIZES[1:])
    sources[2][17] = sources[5][-1] = bad
    sources[4][:4] = np.finfo(dtype).max, -np.finfo(dtype).max, np.finfo(dtype).tiny, 0.0
    joined, counts = np.concatenate(sources), np.array([len(each) for each in sources])
    begin = (np.cumsum(counts) - counts) * joined.itemsize
    nowhere = [np.array([], np.int64)] * len(sources)
    finite = made.take(Parts(joined, begin), counts, np.empty_like(joined), nowhere)[1]
    assert finite == [k not in (2, 5) for k in range(len(sources))]


def test_what_others_write_to_the_targets_changes_no_checksum(made):
    sources = arrays(np.float32)
    bytes_of_targets = [np.zeros(each.nbytes, np.uint8) for each in sources]
    assert made.copy(sources, bytes_of_targets, own_sources=True) == [checksum(each) for each in sources]
    assert [each.tobytes() for each in bytes_of_targets] == [each.tobytes() for each in sources]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_they_are_taken_in_one_behind_the_other_and_what_is_not_positive_is_found(made, dtype):
    sources = [np.abs(each) + 1 for each in arrays(dtype, SIZES[1:])]
    shared = np.array([0, 2, 40, 59])  # of those of 60 and of 61 numbers
    places = [np.array([0]), np.array([], np.int64), shared, shared, np.array([4095]), np.array([0, 70_000])]
    sources[0][0], sources[1][:], sources[2][41] = 0, -1, -1  # only the first is looked at
    sources[3][59], sources[4][17], sources[5][-1] = -0.0, np.inf, np.nan
    counts = np.array([len(each) for each in sources])
    memory, room = np.full(counts.sum(), np.nan, dtype), counts * np.dtype(dtype).itemsize + 24
    begin = np.cumsum(room) - room + 8  # gaps between them
    slot = np.full(room.sum(), 0xFF, np.uint8)
    for first, each in zip(begin.tolist(), sources, strict=True):
        slot[first : first + each.nbytes] = each.view(np.uint8)
    sums, finite, positive = made.take(Parts(slot, begin), counts, memory, places)
    assert memory.tobytes() == b"".join(each.tobytes() for each in sources)
    assert sums == [checksum(each) for each in sources]
    assert finite == [True] * 4 + [False] * 2
    assert positive == [False, True, True, False, True, False]


def test_memory_of_another_size_and_parts_outside_of_their_array_are_mistakes_of_the_caller(made):
    counts, slot = np.array([4]), np.zeros(40, np.uint8)
    made.take(Parts(slot, np.array([8])), counts, np.zeros(4), [np.array([0])])
    for memory in (np.zeros(5), np.zeros(3), np.zeros(4, np.float16), np.zeros(8)[::2]):
        with pytest.raises(ValueError):
            made.take(Parts(slot, np.array([0])), counts, memory, [np.array([0])])
    for begin in (-1, 9, 1 << 62):
        with pytest.raises(ValueError, match="outside"):
            made.take(Parts(slot, np.array([begin])), counts, np.zeros(4), [np.array([0])])


def test_many_large_arrays_are_shared_by_threads(made, monkeypatch):
    monkeypatch.setattr(module, "helping_threads", lambda: 3)
    sources = arrays(np.float64, [ALONE // 8 // 6] * 9)
    targets = [np.empty_like(each) for each in sources]
    assert made.copy(sources, targets) == [checksum(each) for each in sources]
    assert all((target == source).all() for source, target in zip(sources, targets, strict=True))


NO_THREADS = """
import ctypes, resource, sys
import numpy as np
from protocol.shared_memory import copies as module
from protocol.validate import ALONE, checksum

module.helping_threads = lambda: 3
made = module.Copies(ctypes.CDLL(sys.argv[1]))
sources = [np.full(ALONE // 8, float(k)) for k in range(3)]
targets = [np.zeros_like(each) for each in sources]
with open("/proc/self/statm") as file:
    taken = int(file.read().split()[0]) * resource.getpagesize()
before = resource.getrlimit(resource.RLIMIT_AS)
resource.setrlimit(resource.RLIMIT_AS, (taken + (1 << 20), before[1]))  # less than a stack
sums = made.copy(sources, targets)
resource.setrlimit(resource.RLIMIT_AS, before)
print(all(np.array_equal(s, t) for s, t in zip(sources, targets)), sums == [checksum(t) for t in targets])
"""


def test_where_the_system_gives_no_more_threads_one_copies_all():
    """Without an end of the process."""
    words = [sys.executable, "-c", NO_THREADS, str(build(SOURCE, stepping=False))]
    found = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert (found.returncode, found.stdout.split()) == (0, ["True"] * 2), found.stderr


def test_sizes_that_differ_are_a_mistake_of_the_caller(made):
    with pytest.raises(ValueError):
        made.copy([np.zeros(4)], [np.zeros(3)])


PARTS = np.array([8, 4096, 800, 100]), np.array([0, 4112, 24, 640])  # bytes of parts, and where each begins


def test_parts_of_one_array_are_copied_to_parts_of_another(made):
    size, begin = PARTS
    source, target = np.arange(2000.0), np.full(2000, np.nan)
    to = begin[::-1] + np.array([5, 1000, 0, 9000])
    sums = made.copy_parts(Parts(source, begin), Parts(target, to), size)
    parts = [source.view(np.uint8)[a : a + n] for a, n in zip(begin, size, strict=True)]
    assert sums == [checksum(each) for each in parts] == made.sum_parts(Parts(source, begin), size)
    expected = np.full(2000, np.nan).view(np.uint8)
    for a, n, each in zip(to, size, parts, strict=True):
        expected[a : a + n] = each
    assert expected.tobytes() == target.tobytes()


def test_checksums_of_parts_are_of_the_side_that_is_told(made):
    """Of what this process alone writes to: here the two are the same memory at two places."""
    size, memory = np.array([64]), np.arange(24.0)
    overlapping = Parts(memory, np.array([0])), Parts(memory.view(np.uint8), np.array([128]))
    assert made.copy_parts(*overlapping, size, own_sources=True) == [checksum(memory[:8])] == [checksum(memory[16:])]


@pytest.mark.parametrize(("begin", "size"), [(-8, 8), (9, 8), (0, 17), (0, -8), (1 << 62, 1 << 62)])
def test_parts_outside_of_their_array_are_refused(made, begin, size):
    array, inside = np.zeros(2), np.zeros(100)
    parts, size = Parts(array, np.array([0, begin])), np.array([8, size])
    whole = Parts(inside, np.array([0, 64]))
    for call in (
        lambda: made.sum_parts(parts, size),
        lambda: made.copy_parts(parts, whole, size),
        lambda: made.copy_parts(whole, parts, size),
    ):
        with pytest.raises(ValueError, match="outside of its"):
            call()
