# SPDX-License-Identifier: MIT
"""Launches of one domain put together into one kernel: a step of many small launches is mostly the gaps between them.

A launch says in its text what its items are (`int n;  // nodes`). Items of a domain touch only what is their own, and
read other domains in the order elements, nodes, blocks; so all launches of a domain may run one after another in the
thread that has the item. Sums over lists are shared between LANES threads of an item.
"""

import re
from collections.abc import Sequence
from typing import Any

from numpy.typing import NDArray

from sim_server.backend import INCLUDE
from sim_server.gpu.device import DeviceLaunch, Gpu, compiled, cupy

DOMAINS = ("elements", "nodes", "blocks")
LANES = {"elements": 1, "nodes": 8, "blocks": 4}
THREADS = 128


def domain(launch: DeviceLaunch) -> str:
    """What its items are: the first word behind `int n;` in its struct."""
    found = re.search(rf"struct {launch.struct} \{{\s*int n;\s*// (\w+)", launch.text)
    return found.group(1) if found else ""


class Fused:
    """Several launches over the same items as one."""

    def __init__(self, gpu: Gpu, launches: Sequence[DeviceLaunch]):
        self.name = "+".join(launch.name for launch in launches)
        self.items = launches[0].items
        self._lanes = LANES[domain(launches[0])]
        self._arguments: tuple[NDArray[Any], ...] = tuple(launch.params for launch in launches)
        self._launches = list(launches)  # keeps their arrays
        module = cupy().RawModule(
            code=source(launches, self._lanes), options=("-std=c++17", f"-I{INCLUDE}", "-Dreal=double"), backend="nvrtc"
        )
        self._function = compiled(self.name, module, "fused")

    def __call__(self) -> None:
        """Puts it onto the current stream."""
        blocks = max(1, -(-self.items * self._lanes // THREADS))
        self._function((blocks,), (THREADS,), self._arguments)


def source(launches: Sequence[DeviceLaunch], lanes: int) -> str:
    """Text of the kernel `fused`: each text once in a namespace of its own, then one item of each."""
    texts = {launch.text: f"text{k}" for k, launch in enumerate(launches)}
    lines = ["#define ITEMS_ONLY", f"#define LANES_PER_ITEM {lanes}", '#include "polar.cuh"', SUM_BY_LANES]
    for text, name in texts.items():
        body = re.sub(r"^#(include|define WIDE).*$", "", text, flags=re.MULTILINE)
        lines += [f"namespace {name} {{", body, "}"]
    spaces = [texts[launch.text] for launch in launches]
    arguments = ", ".join(f"const {s}::{x.struct} p{k}" for k, (s, x) in enumerate(zip(spaces, launches, strict=True)))
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


def fused(gpu: Gpu, launches: Sequence[DeviceLaunch]) -> list[Any]:
    """The launches in as few kernels as their domains allow; one that may be replaced at any time stays as it is, and
    those before it before it."""
    out: list[Any] = []
    run: list[DeviceLaunch] = []
    for launch in launches:
        if launch.mailed or domain(launch) not in DOMAINS:
            out += [*_by_domain(gpu, run), launch]
            run = []
        else:
            run.append(launch)
    return out + _by_domain(gpu, run)


def _by_domain(gpu: Gpu, launches: Sequence[DeviceLaunch]) -> list[Any]:
    together = [[x for x in launches if domain(x) == d] for d in DOMAINS]
    return [Fused(gpu, group) if len(group) > 1 or group[0].sums else group[0] for group in together if group]
