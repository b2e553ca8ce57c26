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


def gathered(made, sources, target):
    at, size = ([getattr(each, name) for each in sources] for name in ("ctypes", "nbytes"))
    return made.gather(np.array([each.data for each in at]), np.array(size), target)


def test_native_code_has_the_checksum_of_the_package():
    assert module.hash_address() is not None  # else every copy of this suite went by NumPy


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_copies_have_the_checksums_of_their_values(made, dtype):
    sources = arrays(dtype)
    whole = b"".join(each.tobytes() for each in sources)
    target = np.full(len(whole) + 64, 7, np.uint8)
    assert gathered(made, sources, target) == [checksum(each) for each in sources]
    assert target.tobytes() == whole + bytes([7] * 64)


def test_many_large_arrays_are_shared_by_threads(made, monkeypatch):
    monkeypatch.setattr(module, "helping_threads", lambda: 3)
    sources = arrays(np.float64, [ALONE // 8 // 6] * 9)
    target = np.empty(sum(each.nbytes for each in sources), np.uint8)
    assert gathered(made, sources, target) == [checksum(each) for each in sources]
    np.testing.assert_array_equal(target.view(np.float64), np.concatenate(sources))


NO_THREADS = """
import ctypes, resource, sys
import numpy as np
from protocol.shared_memory import copies as module
from protocol.validate import ALONE, checksum

module.helping_threads = lambda: 3
made = module.Copies(ctypes.CDLL(sys.argv[1]))
sources = [np.full(ALONE // 8, float(k)) for k in range(3)]
target = np.zeros(3 * ALONE, np.uint8)
with open("/proc/self/statm") as file:
    taken = int(file.read().split()[0]) * resource.getpagesize()
before = resource.getrlimit(resource.RLIMIT_AS)
resource.setrlimit(resource.RLIMIT_AS, (taken + (1 << 20), before[1]))  # less than a stack
sums = made.gather(np.array([each.ctypes.data for each in sources]), np.full(3, ALONE), target)
resource.setrlimit(resource.RLIMIT_AS, before)
targets = np.split(target.view(np.float64), 3)
print(all(np.array_equal(s, t) for s, t in zip(sources, targets)), sums == [checksum(t) for t in targets])
"""


def test_where_the_system_gives_no_more_threads_one_copies_all():
    """Without an end of the process."""
    words = [sys.executable, "-c", NO_THREADS, str(build(SOURCE, stepping=False))]
    found = subprocess.run(words, capture_output=True, text=True, timeout=120)
    assert (found.returncode, found.stdout.split()) == (0, ["True"] * 2), found.stderr


def test_too_small_a_target_is_a_mistake_of_the_caller(made):
    with pytest.raises(ValueError, match="outside of its"):
        gathered(made, [np.zeros(4), np.zeros(4)], np.zeros(63, np.uint8))


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
