# SPDX-License-Identifier: MIT
"""Fusion of the launches of one domain into one kernel, which saves the gaps between many small launches.

The text of a launch names its domain (`int n;  // nodes`). An item writes only its own rows and reads other domains in
the order of DOMAINS: cells are elements before their patches, corners are those of patches. So all launches of a domain
may run one after another in the thread of an item, and arrays that only they use (`own<T>`) stay in its registers.

Sums over lists come first: `lanes` threads per item add up its entries and leave the sum in shared memory. Then one
thread per item does the rest. A launch whose arguments may be replaced looks up each item in its list (`node`,
ascending).
"""

import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu.cupy_types import KernelFunction
from sim_server.backends.gpu.device import (
    DeviceLaunch,
    compiled,
    cupy,
    folder_options,
    options,
    own_headers,
    processors,
)

DOMAINS = ("cells", "patches", "elements", "corners", "nodes", "blocks")
NUMBERS: dict[str, type[np.number[Any]]] = {"int": np.int32, "float": np.float32, "double": np.float64}


class BlockShape(NamedTuple):
    """Number of threads of a thread block, and of threads that add up the sums of one item (lanes)."""

    threads: int
    lanes: int


BLOCK_SHAPES = {  # by the largest number of items per multiprocessor; few items are spread over many multiprocessors
    "elements": {64: BlockShape(32, 1), 256: BlockShape(64, 1), 1 << 30: BlockShape(128, 1)},
    "patches": {16: BlockShape(64, 16), 256: BlockShape(128, 8), 1 << 30: BlockShape(128, 4)},
    "corners": {64: BlockShape(128, 8), 256: BlockShape(128, 4), 1 << 30: BlockShape(128, 2)},
    "nodes": {16: BlockShape(64, 16), 256: BlockShape(128, 8), 1 << 30: BlockShape(128, 4)},
    "blocks": {64: BlockShape(128, 8), 160: BlockShape(128, 4), 1 << 30: BlockShape(128, 2)},
}


def block_shape(name: str, items: int, multiprocessors: int) -> BlockShape:
    """Returns the shape of the thread blocks for so many items of the domain `name`."""
    return next(s for most, s in BLOCK_SHAPES[name].items() if items <= most * multiprocessors)


class Epilogue(NamedTuple):
    """What the thread blocks of a fused kernel do after their items.

    text: CUDA source. function: device function in it that is called with the struct. params: values of the struct.
    reads: True if it reads arrays that the items write
    """

    text: str
    struct: str
    function: str
    params: NDArray[Any]
    reads: bool = False


class Prologue(NamedTuple):
    """What additional thread blocks of a fused kernel do; they come before those of the items.

    text: CUDA source. function: device function in it that is called with the struct and the index of the thread block.
    params: values of the struct. blocks: number of thread blocks.
    """

    text: str
    struct: str
    function: str
    params: NDArray[Any]
    blocks: int


class Opening(NamedTuple):
    """What a fused kernel does before its launches.

    text: CUDA source. item: device function in it that is called with the struct and each item, before the launches do
    theirs. whole: another one, called once by each thread block with the struct. params: values of the struct
    """

    text: str
    struct: str
    item: str
    whole: str
    params: NDArray[Any]


class PhaseGuard(NamedTuple):
    """Device addresses of arrays that tell whether a later part of a step needs a launch (newton.cu, stages.cuh).

    active: (1,), number of bodies whose step is not made
    phase: (bodies,), phase of each body in the step; DONE: it is made
    body: (items,), body of each item; 0 (no address): not known
    """

    active: int
    phase: int
    body: int

    @property
    def condition(self) -> str:
        """What holds for the phase of a body that needs the launch."""
        return f"!= {PHASE['DONE']}"

    @property
    def lines(self) -> list[str]:
        """The beginning of a kernel."""
        return [
            "if (*active == 0) return;",
            "if (body && !__syncthreads_or(threadIdx.x < BLOCK_ITEMS && block * BLOCK_ITEMS + threadIdx.x < n &&",
            f"                              phase[body[block * BLOCK_ITEMS + threadIdx.x]] {self.condition})) return;",
        ]


class SolveGuard(PhaseGuard):
    """The same of a launch that only bodies need whose linear system is solved next."""

    @property
    def condition(self) -> str:
        return f"== {PHASE['SOLVE']}"


PHASE = Declarations("kernels/newton_line_search.cuh").enumeration("Phase")
OPEN_ITEM = f"(!body || phase[body[i]] != {PHASE['DONE']})"


class FusedKernel:
    """Launches several kernels over the same items as one.

    private: addresses of arrays that need no memory, since only these launches use them (`own`)
    exact: see FusedSource
    """

    def __init__(
        self, launches: Sequence[DeviceLaunch], epilogue: Epilogue | None = None, private: frozenset[int] = frozenset(),
        guard: PhaseGuard | None = None, prologue: Prologue | None = None, exact: bool = False,
        opening: Opening | None = None,
    ):  # fmt: skip
        self.name = "+".join(launch.name for launch in launches)
        self.items = next(launch.items for launch in launches if not launch.mailed)
        sums = any(launch.sums for launch in launches)
        self.shape = block_shape(launches[0].domain if sums else "elements", self.items, processors())
        self._launches = list(launches)  # keeps their arrays
        self._prologue_blocks = prologue.blocks if prologue else 0
        text = FusedSource(launches, self.shape, epilogue, private, guard, prologue, exact, opening)
        parts: tuple[Epilogue | Prologue | Opening | None, ...] = (epilogue, prologue, opening)
        self._arguments = (np.int32(self.items), *text.values, *(x.params for x in parts if x))
        folders = folder_options(*(launch.folder for launch in launches))
        flags = (*options(launches[0].types), *own_headers(), *folders)
        self._module = cupy().RawModule(code=text.source, options=flags, backend="nvrtc")
        self._function = self.function("fused")
        self._has_epilogue = epilogue is not None

    def function(self, kernel: str) -> KernelFunction:
        """Returns a kernel of the whole text."""
        return compiled(self.name, self._module, kernel)

    def __call__(self) -> None:
        """Appends the launch to the current stream."""
        if self.items or self._has_epilogue:
            blocks = max(1, -(-self.items * self.shape.lanes // self.shape.threads))
            self._function((self._prologue_blocks + blocks,), (self.shape.threads,), self._arguments)


class FusedSource:
    """CUDA source of the kernel `fused` of some launches.

    Each array is one argument, even if several launches use it, and arguments do not overlap. So the compiler may keep
    its entries in registers from one launch to the next.

    private: addresses of arrays that need no memory
    guard: thread blocks return at once if they have no item of a body whose step is not made, unless there is an
        epilogue
    exact: other items of bodies whose step is made are left out, too; not for kernels whose threads write rows together
    opening: writes arrays that the launches read

    source: the text
    values: of the arguments after the number of items
    """

    def __init__(
        self, launches: Sequence[DeviceLaunch], shape: BlockShape, epilogue: Epilogue | None = None,
        private: frozenset[int] = frozenset(), guard: PhaseGuard | None = None, prologue: Prologue | None = None,
        exact: bool = False, opening: Opening | None = None,
    ):  # fmt: skip
        self._launches, self._private, self._exact, self._opening = launches, private, exact, opening
        self._restrict = "" if opening or (epilogue and epilogue.reads) else "__restrict__ "
        self.values: list[np.number[Any]] = [np.uint64(address) for address in guard or ()]
        self._parameters = [f"const int* __restrict__ {name}" for name in guard._fields] if guard else []
        self._setup: list[str] = []
        self._names: dict[int, str] = {}
        texts = {launch.text: f"text{k}" for k, launch in enumerate(launches)}
        self._spaces = [texts[launch.text] for launch in launches]
        self._written = {
            launch.arrays[f.name].data.ptr
            for launch in launches for f in launch.fields if f.dtype is not None and not f.constant
        }  # fmt: skip
        lines = ["#define ITEMS_ONLY", f"#define BLOCK_ITEMS {shape.threads // shape.lanes}"]
        headers = [h for text in texts for h in re.findall(r'^#include "[^"]+"', text, re.MULTILINE)]
        lines += dict.fromkeys([*headers, '#include "warp_reduce.cuh"'])  # outside of the texts' namespaces, once
        for text, name in texts.items():
            body = re.sub(r"^#(include|define WIDE).*$", "", text, flags=re.MULTILINE)
            lines += [f"namespace {name} {{", body, "}"]
        body_lines = [*self._sums(shape), *self._items()]
        if epilogue:
            lines.append(epilogue.text)
            self._parameters.append(f"const {epilogue.struct} epilogue")
            body_lines.append(f"{epilogue.function}(epilogue);")
        begin = [f"const int block = (int)blockIdx.x - {prologue.blocks if prologue else 0};"]
        if prologue:
            lines.append(prologue.text)
            self._parameters.append(f"const {prologue.struct} prologue")
            begin.append(f"if (block < 0) {{ {prologue.function}(prologue, blockIdx.x); return; }}")
        if self._opening:
            lines.append(self._opening.text)
            self._parameters.append(f"const {self._opening.struct} opened")
            begin.append(f"{self._opening.whole}(opened);")
        heading = f'extern "C" __global__ void __launch_bounds__({shape.threads}) fused(int n'
        parameters = "".join(f", {p}" for p in self._parameters)
        begin += guard.lines if guard and not epilogue else []
        lines += [f"{heading}{parameters}) {{", *begin, *self._setup, *body_lines, "}"]
        self.source = "\n".join(lines)

    def _each(self) -> Iterator[tuple[int, DeviceLaunch, str, str]]:
        for k, (launch, space) in enumerate(zip(self._launches, self._spaces, strict=True)):
            yield k, launch, space, launch.name.split(".")[1]

    def _sums(self, shape: BlockShape) -> list[str]:
        """Sets up the arguments, and returns the lines that sum over the lists."""
        for k, launch, space, _ in self._each():
            if launch.mailed:
                self._parameters.append(f"const {space}::{launch.struct}* mail{k}")
                self.values.append(np.uint64(launch.mail_address))
                self._setup.append(f"const int touched{k} = mail{k}->n;")
            else:
                self._setup += [f"{space}::{launch.struct} p{k};", f"p{k}.n = n;"]
                self._setup += self._members(k, launch)
        sums = [(k, space, kernel) for k, launch, space, kernel in self._each() if launch.sums]
        if not sums:
            return []
        lines = ["constexpr int ROWS = BLOCK_ITEMS;"]
        for k, space, kernel in sums:
            lines += [f"constexpr int SIZE{k} = padded({space}::{kernel}_sums, {shape.lanes});"]
            lines += [f"__shared__ local sums{k}[ROWS][SIZE{k} | 1];"]
        lines += [f"{{ const int slot = threadIdx.x / {shape.lanes}, lane = threadIdx.x % {shape.lanes};"]
        lines += ["const int i = block * ROWS + slot;"]
        for k, space, kernel in sums:
            lines += [
                f"{{ local sum[SIZE{k}];",
                f"for (int m = 0; m < SIZE{k}; ++m) sum[m] = 0;",
                f"if (i < n) for (int k = p{k}.start[i] + lane, end = p{k}.start[i + 1]; k < end; k += {shape.lanes})",
                f"    {space}::{kernel}_add(p{k}, i, k, sum);",
                f"share_sum<SIZE{k}, {shape.lanes}>(sum, lane, sums{k}[slot]); }}",
            ]
        return [*lines, "}", "__syncthreads();"]

    def _members(self, k: int, launch: DeviceLaunch) -> Iterator[str]:
        for f in launch.fields[1:]:
            if f.dtype is None:
                self._parameters.append(f"{f.kind} p{k}_{f.name}")
                kind = NUMBERS[f.kind]
                self.values.append(kind(launch.params[f.name]))
                yield f"p{k}.{f.name} = p{k}_{f.name};"
            elif not f.own:
                yield f"p{k}.{f.name} = {self._array(launch, f.name, f.kind)};"

    def _array(self, launch: DeviceLaunch, name: str, kind: str) -> str:
        """Returns the name of the kernel's argument for an array."""
        array = launch.arrays[name]
        address = int(array.data.ptr)
        if array.size == 0:
            return "nullptr"
        if address not in self._names:
            self._names[address] = f"a{len(self._names)}"
            const = "" if address in self._written else "const "
            self._parameters.append(f"{const}{kind}* {self._restrict}{self._names[address]}")
            self.values.append(np.uint64(address))
        return self._names[address]

    def _items(self) -> list[str]:
        """Returns the lines that do one item of each launch in one thread."""
        taken = f" && {OPEN_ITEM}" if self._exact else ""
        lines = [
            "const int i = block * BLOCK_ITEMS + threadIdx.x;",
            f"if (threadIdx.x < BLOCK_ITEMS && i < n{taken}) {{",
            *([f"{self._opening.item}(opened, i);"] if self._opening else []),
        ]
        rows: dict[int, str] = {}
        for k, launch, space, kernel in self._each():
            own = list(self._rows(launch, rows, lines))
            if launch.mailed:
                lines += [
                    f"if (touched{k}) {{ const int here = place(mail{k}->node, touched{k}, i);",
                    f"    if (here >= 0) {{ {space}::{launch.struct} p{k} = *mail{k};",
                    *(f"        p{k}.{name}.item = {row};" for name, row in own),
                    f"        {space}::{kernel}_item(p{k}, here); }} }}",
                ]
                continue
            lines += [f"p{k}.{name}.item = {row};" for name, row in own]
            last = f"_put(p{k}, i, sums{k}[threadIdx.x])" if launch.sums else f"_item(p{k}, i)"
            lines.append(f"{space}::{kernel}{last};")
        return [*lines, "}"]

    def _rows(self, launch: DeviceLaunch, rows: dict[int, str], lines: list[str]) -> Iterator[tuple[str, str]]:
        """Yields member and expression of the item's row for each `own` array."""
        for f in (f for f in launch.fields if f.own):
            array = launch.arrays[f.name]
            address = int(array.data.ptr)
            width = int(np.prod(array.shape[1:]))
            if address not in rows:
                if address in self._private:
                    rows[address] = f"row{len(rows)}"
                    lines.append(f"{f.kind} {rows[address]}[{width}];")
                else:
                    rows[address] = f"{self._array(launch, f.name, f.kind)} + {width} * (long long)i"
            yield f.name, rows[address]


def fuse(
    launches: Sequence[DeviceLaunch],
    guard: Callable[[Sequence[DeviceLaunch]], PhaseGuard] | None = None,
    prologue: Prologue | None = None,
    after: Sequence[DeviceLaunch] = (),
    readers: Sequence[DeviceLaunch] = (),
    beside: Prologue | None = None,
) -> list[FusedKernel | DeviceLaunch]:
    """Fuses launches into as few kernels as their domains allow.

    guard: makes the guard of a kernel from its launches
    prologue: of the first kernel
    beside: of the last kernel, if it is not the first one too
    after: launches that follow, one by one
    readers: launches elsewhere that read what these write
    """
    if any(launch.domain not in DOMAINS for launch in launches):
        return [*launches, *after]
    together = [group for d in DOMAINS for group in _by_items([x for x in launches if x.domain == d])]
    together = [group for group in together if group]
    every = [*launches, *after, *readers]
    prologues = [prologue, *([None] * (len(together) - 2)), beside][: len(together)]
    fused = [
        FusedKernel(group, None, _private(group, every), guard(group) if guard else None, first)
        for group, first in zip(together, prologues, strict=True)
    ]
    return [*fused, *after]


def _by_items(launches: Sequence[DeviceLaunch]) -> list[list[DeviceLaunch]]:
    """Groups launches of one domain by number of items, since the elements of two effects differ."""
    counts = {x.items: None for x in launches if not x.mailed}
    return [[x for x in launches if x.mailed or x.items == n] for n in counts]


def _private(group: Sequence[DeviceLaunch], launches: Sequence[DeviceLaunch]) -> frozenset[int]:
    """Returns the addresses of the arrays that only launches of this group use, all of them as `own`."""
    owned: set[int] = set()
    others: set[int] = set()
    for launch in launches:
        inside = any(launch is x for x in group)
        for f in launch.fields:
            if f.dtype is not None:
                (owned if f.own and inside else others).add(int(launch.arrays[f.name].data.ptr))
    return frozenset(owned - others)
