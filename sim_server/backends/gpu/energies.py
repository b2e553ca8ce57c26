# SPDX-License-Identifier: MIT
"""The energy of bodies on a GPU: its memory, the elastic energy on demand, and the start that all is reckoned from.

Everything but the elastic energy is summed up after each step, by thread blocks of the first kernel of the next one
(energy_balance.cu).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.compiler import HERE
from sim_server.backends.cpu.structs import BALANCE
from sim_server.backends.gpu.device import Gpu, compiled, options, own_headers
from sim_server.backends.gpu.kernel_fusion import Prologue
from sim_server.backends.gpu.mailbox import library
from sim_server.backends.gpu.structs import ENERGY_RECORD
from sim_server.mechanics.energy import CODES, Energies

THREADS = 128  # of a thread block of elastic_energy.cu
NODES = 128  # that a thread block sums over
STILL = 5  # arrays that are 0 in a body at rest, at most
SUMS = 10  # double numbers in Sums (kernels/energy_balance.cuh)
ENERGY_BALANCE = np.dtype(
    [(n, "u8") for n in ("first_node", "chunks", "sums", "finished_chunks", "mass", "before", "x", "v")]
    + [("still", "u8", STILL)]
    + [(n, "u8") for n in ("force", "spring", "anchor", "free", "gravity", "balance", "records")]
    + [(n, "u8") for n in ("step", "settled_step")]
    + [(n, "i4") for n in ("bodies", "capacity", "on_runaway", "inertia")]
)
NODE_CHUNK = np.dtype([(n, "i4") for n in ("body", "begin", "end", "first", "chunks")])
ELASTIC_ENERGY = np.dtype(
    [(n, "u8") for n in ("energy", "first_element", "sum", "step", "balance", "records")]
    + [("capacity", "i4"), ("first_effect", "i4")]
)  # fmt: skip


class DeviceEnergies:
    """Energies of the bodies of a scene on the device.

    records: host memory (capacity, bodies) of ENERGY_RECORD that the device writes to
    counter: device array (1,), number of completed steps

    prologue: energy balance of the last step, for additional thread blocks of the first kernel of the next step
    threads: of these thread blocks; the order of summation depends on it
    """

    def __init__(self, gpu: Gpu, energies: Energies, records: NDArray[np.uint8], counter: Any, dt: float):
        self._gpu, self._energies, self._dt, self._counter = gpu, energies, dt, counter
        cp, world = gpu.cp, energies.world
        starts = np.array([*(b.first for b in world.bodies), world.nodes], np.int32)
        self._bodies, self._capacity = len(world.bodies), records.nbytes // ENERGY_RECORD.itemsize // len(world.bodies)
        self.threads, self.started = THREADS, False
        chunk = chunked(starts, NODES)
        self._balance = cp.asarray(np.frombuffer(energies.balance.tobytes(), np.uint8))
        self._settled, self._sum = cp.zeros(self._bodies, np.int64), cp.zeros(self._bodies)
        self._memory: dict[str, Any] = {
            "first_node": cp.asarray(starts), "chunks": cp.asarray(chunk.view(np.int32)),
            "sums": cp.zeros((len(chunk), SUMS)), "finished_chunks": cp.zeros(self._bodies, np.uint32),
            "mass": gpu.twin(world.mass), "free": gpu.twin(world.free), "before": gpu.twin(energies.before),
            "x": gpu.twin(world.x), "v": gpu.twin(world.v), "gravity": gpu.twin(energies.gravity),
            "balance": self._balance, "step": counter, "settled_step": self._settled,
        }  # fmt: skip
        if energies.touch is not None:
            self._memory |= {n: gpu.twin(getattr(energies.touch, n)) for n in ("force", "spring", "anchor")}
        self._params = np.zeros((), ENERGY_BALANCE)
        for name, array in self._memory.items():
            self._params[name] = array.data.ptr
        still = [gpu.twin(array) for array in energies.still]
        self._params["still"][: len(still)] = [array.data.ptr for array in still]
        self._memory |= {f"still{k}": array for k, array in enumerate(still)}
        self._params["records"], self._params["capacity"] = records.ctypes.data, self._capacity
        self._params["bodies"], self._params["inertia"] = self._bodies, world.inertia
        self._params["on_runaway"] = CODES[energies.on_runaway]
        self.prologue = Prologue(text("energy_balance"), "EnergyBalance", "balance_energy", self._params, len(chunk))
        self._account, self._add = (
            self._function(*names)
            for names in (("energy_balance", "energy_balance"), ("elastic_energy", "elastic_energy"))
        )
        self._launches = self._elastic(records)

    def _function(self, name: str, kernel: str) -> Any:
        module = self._gpu.cp.RawModule(
            code=text(name), options=(*options(self._gpu.types), *own_headers()),
            backend="nvrtc",
        )  # fmt: skip
        return compiled(f"{name}.cu", module, kernel)

    def _elastic(self, records: NDArray[np.uint8]) -> list[tuple[Any, Any, NDArray[Any]]]:
        """(what evaluates the energies of the elements, its array, arguments of the sums over them) for each effect."""
        cp = self._gpu.cp
        found = [(e.launch, e.launch.arrays["energy"], self._energies.parts(e)) for e in self._energies.elastic]
        found = found or [(None, cp.zeros(1), np.zeros(self._bodies + 1, np.int32))]
        made = []
        for k, (launch, array, parts) in enumerate(found):
            params, kept = np.zeros((), ELASTIC_ENERGY), cp.asarray(parts)
            self._memory[f"parts{k}"] = kept
            params["energy"], params["first_element"], params["sum"] = array.data.ptr, kept.data.ptr, self._sum.data.ptr
            params["step"], params["balance"] = self._counter.data.ptr, self._balance.data.ptr
            params["records"], params["capacity"], params["first_effect"] = records.ctypes.data, self._capacity, k == 0
            made.append((launch, array, params))
        return made

    def account(self) -> None:
        """Puts the account of the last step onto the current stream; one that is settled already is left alone."""
        self._account((self.prologue.blocks,), (self.threads,), (self._params,))

    def elastic(self) -> None:
        """Puts the evaluation of the elastic energy of the last step, which is settled, onto the current stream."""
        for launch, _, params in self._launches:
            if launch is not None:
                launch()
            self._add((self._bodies,), (THREADS,), (params,))

    def start(self) -> None:
        """Reckons from the state that is on the device now, before the first step."""
        e, w = self._energies, self._energies.world
        self.elastic()
        self._settled[:] = self._counter
        x, v = (self._gpu.twin(array).get().astype(float) for array in (w.x, w.v))
        balance = np.frombuffer(self._balance.get().tobytes(), BALANCE).copy()
        balance["elastic"] = self._sum.get()
        for body in w.bodies:
            row = balance[body.index : body.index + 1]
            sums = start_sums(w.mass[body.nodes], x[body.nodes], v[body.nodes], e.gravity, self._dt)
            library().wf_gpu_start_balance(row.ctypes.data, sums.ctypes.data, self._dt, int(w.inertia))
        self._balance.set(np.frombuffer(balance.tobytes(), np.uint8))
        self.started = True


def chunked(starts: NDArray[np.int32], nodes: int) -> NDArray[Any]:
    """The nodes of bodies in chunks of so many (NODE_CHUNK). starts: (bodies + 1,) node of each body."""
    counts = -(-np.diff(starts) // nodes)
    chunks = np.zeros(counts.sum(), NODE_CHUNK)
    body = chunks["body"] = np.repeat(np.arange(len(counts)), counts)
    chunks["chunks"], chunks["first"] = counts[body], (np.cumsum(counts) - counts)[body]
    chunks["begin"] = starts[body] + nodes * (np.arange(len(chunks)) - chunks["first"])
    chunks["end"] = np.minimum(chunks["begin"] + nodes, starts[body + 1])
    return chunks


def text(name: str) -> str:
    """Of gpu/<name>.cu."""
    return (HERE / f"backends/gpu/{name}.cu").read_text()


def start_sums(
    mass: NDArray[np.float64], x: NDArray[np.float64], v: NDArray[np.float64], gravity: NDArray[np.float64], dt: float
) -> NDArray[np.float64]:
    """Kinetic energy and that of gravity [J], the largest difference of dt v along an axis and the diagonal [m]."""
    stride = float(dt * np.ptp(v, axis=0).max())
    diagonal = float(np.linalg.norm(np.ptp(x, axis=0)))
    return np.array([0.5 * mass @ (v**2).sum(axis=1), -mass @ (x @ gravity), stride, diagonal])
