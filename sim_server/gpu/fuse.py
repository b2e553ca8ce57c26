# SPDX-License-Identifier: MIT
"""Launches of one domain put together into one kernel: a step of many small launches is mostly the gaps between them.

A launch says in its text what its items are (`int n;  // nodes`). Items of a domain touch only what is their own, and
read other domains in the order elements, nodes, blocks; so all launches of a domain may run one after another in the
thread that has the item. Sums over lists are shared between LANES threads of an item.
"""

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

from numpy.typing import NDArray

from sim_server.backend import INCLUDE
from sim_server.gpu.device import DeviceLaunch, compiled, cupy, shape, texts

DOMAINS = ("elements", "nodes", "blocks")
LANES = {"elements": 1, "nodes": 8, "blocks": 4}


def domain(launch: DeviceLaunch) -> str:
    """What its items are: the first word behind `int n;` in its struct."""
    found = re.search(rf"struct {launch.struct} \{{\s*int n;\s*// (\w+)", launch.text)
    return found.group(1) if found else ""


class End(NamedTuple):
    """What follows when all items are done: a text, its function of the same name as its struct in small letters, and
    the struct's values."""

    text: str
    struct: str
    params: NDArray[Any]


class Fused:
    """Several launches over the same items as one."""

    def __init__(self, launches: Sequence[DeviceLaunch], end: End | None = None):
        self.name = "+".join(launch.name for launch in launches)
        self.items = launches[0].items
        self._lanes = LANES[domain(launches[0])] if any(launch.sums for launch in launches) else 1
        self._arguments: tuple[NDArray[Any], ...] = tuple(launch.params for launch in launches)
        if end:
            self._arguments += (end.params,)
        self._launches = list(launches)  # keeps their arrays
        self._module = cupy().RawModule(
            code=source(launches, self._lanes, end),
            options=("-std=c++17", f"-I{INCLUDE}", "-Dreal=double", texts()),
            backend="nvrtc",
        )
        self._function = self.function("fused")

    def function(self, kernel: str) -> Any:
        """A kernel of the whole text."""
        return compiled(self.name, self._module, kernel)

    def __call__(self) -> None:
        """Puts it onto the current stream."""
        self._function(*shape(self.items * self._lanes), self._arguments)


def source(launches: Sequence[DeviceLaunch], lanes: int, end: End | None = None) -> str:
    """Text of the kernel `fused`: each text once in a namespace of its own, then one item of each, then the end."""
    texts = {launch.text: f"text{k}" for k, launch in enumerate(launches)}
    lines = ["#define ITEMS_ONLY", f"#define LANES_PER_ITEM {lanes}", '#include "polar.cuh"', SUM_BY_LANES]
    for text, name in texts.items():
        body = re.sub(r"^#(include|define WIDE).*$", "", text, flags=re.MULTILINE)
        lines += [f"namespace {name} {{", body, "}"]
    spaces = [texts[launch.text] for launch in launches]
    arguments = ", ".join(f"const {s}::{x.struct} p{k}" for k, (s, x) in enumerate(zip(spaces, launches, strict=True)))
    if end:
        lines.append(end.text)
        arguments += f", const {end.struct} end"
    lines += [
        f'extern "C" __global__ void fused({arguments}) {{',
        "    int thread = blockIdx.x * blockDim.x + threadIdx.x, i = thread / LANES_PER_ITEM;",
        "    int lane = thread % LANES_PER_ITEM;",
        "    bool here = i < p0.n;",
    ]
    for k, (space, launch) in enumerate(zip(spaces, launches, strict=True)):
        kernel = launch.name.split(".")[1]
        if launch.sums:
            lines.append(f"    SUM_BY_LANES({space}::{kernel}, p{k})")
        else:
            lines.append(f"    if (here && lane == 0) {space}::{kernel}_item(p{k}, i);")
    if end:
        lines.append(f"    {end.struct.lower()}(end);")
    return "\n".join([*lines, "}"])


SUM_BY_LANES = """
#define SUM_BY_LANES(name, p) {                                                               \\
    real sum[name##_reals];                                                                   \\
    for (int m = 0; m < name##_reals; ++m) sum[m] = 0;                                        \\
    if (here) for (int k = p.start[i] + lane; k < p.start[i + 1]; k += LANES_PER_ITEM)        \\
        name##_add(p, i, k, sum);                                                             \\
    for (int step = LANES_PER_ITEM / 2; step; step >>= 1)                                     \\
        for (int m = 0; m < name##_reals; ++m) sum[m] += __shfl_xor_sync(0xffffffffu, sum[m], step); \\
    if (here && lane == 0) name##_put(p, i, sum);                                             \\
}
"""


def fused(launches: Sequence[DeviceLaunch]) -> list[Any]:
    """The launches in as few kernels as their domains allow; one that may be replaced at any time stays as it is, and
    those before it before it."""
    out: list[Any] = []
    run: list[DeviceLaunch] = []
    for launch in launches:
        if launch.mailed or domain(launch) not in DOMAINS:
            out += [*_by_domain(run), launch]
            run = []
        else:
            run.append(launch)
    return out + _by_domain(run)


def _by_domain(launches: Sequence[DeviceLaunch]) -> list[Any]:
    together = [[x for x in launches if domain(x) == d] for d in DOMAINS]
    return [Fused(group) if len(group) > 1 or group[0].sums else group[0] for group in together if group]
