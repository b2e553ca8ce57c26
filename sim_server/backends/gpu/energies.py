# SPDX-License-Identifier: MIT
"""Energy balance of bodies on a GPU: memory, launches, and the initial energy.

All but the elastic energy is summed after each step by thread blocks of the first kernel of the next step
(energy_balance.cu); the elastic energy is evaluated on demand (elastic_energy.cu).
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int32, Int64
from sim_server.backends.declarations import Declarations
from sim_server.backends.energies import CODES, Energies
from sim_server.backends.gpu.cupy_types import DeviceArray, KernelFunction
from sim_server.backends.gpu.device import DeviceLaunch, Gpu, compiled, options, own_headers
from sim_server.backends.gpu.kernel_fusion import Prologue
from sim_server.backends.gpu.mailbox import library
from sim_server.backends.gpu.pinned import pinned_array
from sim_server.backends.gpu.state import device_arrays
from sim_server.backends.state import StateArray

BALANCE_TEXT = Declarations("backends/gpu/energy_balance.cu")
ELASTIC_TEXT = Declarations("backends/gpu/elastic_energy.cu")
THREADS: int = ELASTIC_TEXT.constant("THREADS")  # of a thread block of elastic_energy.cu
NODES = 128  # nodes that a thread block sums over
ENERGY_BALANCE = BALANCE_TEXT.dtype("EnergyBalance")
BALANCE, ENERGY_RECORD = BALANCE_TEXT.dtype("Balance"), BALANCE_TEXT.dtype("EnergyRecord")
NODE_CHUNK = BALANCE_TEXT.dtype("NodeChunk")
SUMS = BALANCE_TEXT.dtype("Sums").itemsize // 8  # numbers
ELASTIC_ENERGY, ELASTIC_WORK = ELASTIC_TEXT.dtype("ElasticEnergy"), ELASTIC_TEXT.dtype("ElasticWork")


class DeviceEnergies:
    """Energies of the bodies of a scene on the device.

    capacity: steps whose records are kept
    counter: device array (1,), number of completed steps

    records: device ring (capacity, bodies) of ENERGY_RECORD
    prologue: energy balance of the last step, for additional thread blocks of the first kernel of the next step
    threads: of these thread blocks; the order of summation depends on it
    """

    def __init__(self, gpu: Gpu, energies: Energies, capacity: int, counter: DeviceArray, dt: float):
        self._gpu, self._energies, self._dt, self._counter = gpu, energies, dt, counter
        cp, e, bodies = gpu.cp, energies, len(energies.starts) - 1
        self._bodies, self._capacity = bodies, capacity
        self.records: DeviceArray = cp.zeros(capacity * bodies * ENERGY_RECORD.itemsize, np.uint8)
        self.threads, self.started = THREADS, False
        chunks = node_chunks(e.starts, NODES)
        self._balance = cp.asarray(np.frombuffer(e.balance.tobytes(), np.uint8))
        self._settled, self._sum = cp.zeros(self._bodies, np.int64), cp.zeros(self._bodies)
        self._memory: dict[str, DeviceArray] = {
            "first_node": cp.asarray(e.starts), "chunks": cp.asarray(chunks.view(np.int32)),
            "sums": cp.zeros((len(chunks), SUMS)), "finished_chunks": cp.zeros(self._bodies, np.uint32),
            "mass": gpu.twin(e.mass), "free": gpu.twin(e.free), "before": gpu.twin(e.before),
            "x": gpu.twin(e.x), "v": gpu.twin(e.v), "gravity": gpu.twin(e.gravity),
            "balance": self._balance, "step": counter, "settled_step": self._settled,
        }  # fmt: skip
        self._memory |= {name: gpu.twin(array) for name, array in e.touch.items()}
        self._params = np.zeros((), ENERGY_BALANCE)
        for name, array in self._memory.items():
            self._params[name] = array.data.ptr
        still = [gpu.twin(array) for array in e.still]
        self._params["still"][: len(still)] = [array.data.ptr for array in still]
        self._memory |= {f"still{k}": array for k, array in enumerate(still)}
        self._params["records"], self._params["capacity"] = self.records.data.ptr, self._capacity
        self._params["bodies"], self._params["inertia"] = self._bodies, e.inertia
        self._params["on_runaway"] = CODES[e.on_runaway]
        self.prologue = Prologue(BALANCE_TEXT.checked(), "EnergyBalance", "balance_energy", self._params, len(chunks))
        self._balance_kernel = self._kernel(BALANCE_TEXT, "energy_balance")
        self._elastic_kernels = dict[np.dtype, KernelFunction]()  # by the type of the energies of an effect's elements
        self._launches = self._elastic()

    def _kernel(self, text: Declarations, name: str, types: dict[str, str] | None = None) -> KernelFunction:
        """Compiles the kernel of the text <name>.cu. types: of `real` and `local`, if other than the scene's"""
        flags = (*options(types or self._gpu.types), *own_headers())
        module = self._gpu.cp.RawModule(code=text.checked(), options=flags, backend="nvrtc")
        return compiled(f"{name}.cu", module, name)

    def _elastic(self) -> list[tuple[DeviceLaunch | None, DeviceArray, NDArray[Any]]]:
        """Returns per effect the launch that evaluates the element energies, their array, and arguments of the sum."""
        cp = self._gpu.cp
        found = [(e.launch, e.launch.arrays["energy"], self._energies.parts(e)) for e in self._energies.elastic]
        found = found or [(None, cp.zeros(1), np.zeros(self._bodies + 1, np.int32))]
        made = []
        for k, (launch, array, parts) in enumerate(found):
            params, kept = np.zeros((), ELASTIC_ENERGY), cp.asarray(parts)
            self._memory[f"parts{k}"] = kept
            params["energy"], params["first_element"], params["sum"] = array.data.ptr, kept.data.ptr, self._sum.data.ptr
            params["step"], params["balance"] = self._counter.data.ptr, self._balance.data.ptr
            params["records"], params["capacity"] = self.records.data.ptr, self._capacity
            params["first_effect"] = k == 0
            if array.dtype not in self._elastic_kernels:
                types = types_of_energies(self._gpu.types, array.dtype)
                self._elastic_kernels[array.dtype] = self._kernel(ELASTIC_TEXT, "elastic_energy", types)
            made.append((launch, array, params))
        return made

    @property
    def params(self) -> NDArray[Any]:
        """Arguments of the energy balance (EnergyBalance)."""
        return self._params

    @property
    def balance(self) -> DeviceArray:
        """Balances of the bodies (BALANCE) on the device."""
        balance: DeviceArray = self._balance
        return balance

    def launch_balance(self) -> None:
        """Launches the energy balance of the last step; does nothing on the device if it was settled before."""
        self._balance_kernel((self.prologue.blocks,), (self.threads,), (self._params,))

    def launch_elastic(self) -> None:
        """Launches the evaluation of the elastic energy of the last step, which is settled."""
        for launch, array, params in self._launches:
            if launch is not None:
                launch()
            self._elastic_kernels[array.dtype]((self._bodies,), (THREADS,), (params,))

    def prepare_work(self) -> None:
        """Allocates and compiles what `launch_work` needs."""
        cp = self._gpu.cp
        self._memory["scratch"] = cp.zeros(self._bodies * ENERGY_RECORD.itemsize, np.uint8)
        self._memory["before"] = cp.zeros(self._bodies)
        self._work_kernel = self._kernel(ELASTIC_TEXT, "elastic_work")

    def launch_work(self, after: bool) -> None:
        """Launches what makes work of the elastic energy that a change of parameters adds. after: it is made."""
        for launch, array, params in self._launches:
            if launch is not None:
                launch()
            apart = params.copy()  # no record of a step tells of it
            apart["records"], apart["capacity"] = self._memory["scratch"].data.ptr, 1
            self._elastic_kernels[array.dtype]((self._bodies,), (THREADS,), (apart,))
        work = np.zeros((), ELASTIC_WORK)
        work["sum"], work["before"] = self._sum.data.ptr, self._memory["before"].data.ptr
        work["balance"], work["bodies"], work["after"] = self._balance.data.ptr, self._bodies, after
        self._work_kernel((-(-self._bodies // THREADS),), (THREADS,), (work,))

    def state(self) -> list[StateArray]:
        """Returns what steps carry on."""
        memory = {"balance": self._balance, "settled": self._settled, "sum": self._sum}
        return device_arrays("engine.energies", memory, *memory)

    def start(self, bodies: Sequence[int] | None = None) -> None:
        """Takes the state on the device as the initial state of the balance.

        bodies: only these, which were put back to the start, also if they were frozen
        """
        e = self._energies
        self.launch_elastic()
        self._settled[:] = self._counter
        x, v = (self._on_host(self._gpu.twin(array)) for array in (e.x, e.v))
        balance = np.frombuffer(self._balance.get().tobytes(), BALANCE).copy()
        starts = np.arange(len(balance)) if bodies is None else np.array(bodies, np.int64)
        balance["elastic"][starts] = self._sum.get()[starts]
        if bodies is not None:
            balance["phase"][starts] = 0  # WELL
        start_balances(balance, starts, e, x, v, self._dt)
        self._balance.set(np.frombuffer(balance.tobytes(), np.uint8))
        self.started = True

    def _on_host(self, twin: DeviceArray) -> NDArray[Any]:
        """Copies an array to page-locked memory, which is used again: the pages of other memory take longer to come
        than the values of a thousand bodies."""
        host = pinned_array(self._gpu.cp, twin.size, twin.dtype).reshape(twin.shape)
        return twin.get(out=host)


def types_of_energies(types: dict[str, str], energy: np.dtype) -> dict[str, str]:
    """Returns the types by which elastic_energy.cu sums the energies of an effect: kernels write them as `local` or as
    `real`, which differ in mixed precision. types: of the scene (device.PRECISIONS)"""
    return types | {"local": "float" if energy == np.float32 else "double"}


def node_chunks(starts: Int32, nodes: int) -> NDArray[Any]:
    """Returns chunks (NODE_CHUNK) of at most `nodes` nodes. starts: (bodies + 1,), first node of each body."""
    counts = -(-np.diff(starts) // nodes)
    chunks = np.zeros(counts.sum(), NODE_CHUNK)
    body = chunks["body"] = np.repeat(np.arange(len(counts)), counts)
    chunks["chunks"], chunks["first"] = counts[body], (np.cumsum(counts) - counts)[body]
    chunks["begin"] = starts[body] + nodes * (np.arange(len(chunks)) - chunks["first"])
    chunks["end"] = np.minimum(chunks["begin"] + nodes, starts[body + 1])
    return chunks


def start_balances(
    balance: NDArray[Any], bodies: Int64, e: Energies, x: NDArray[Any], v: NDArray[Any], dt: float
) -> None:
    """Starts the balances (BALANCE) of some bodies in a state; `elastic` and `diagonal` are set already.

    x, v: (n, 3) [m], [m/s], of type float64 or float32. dt [s]
    """
    mass, gravity = (np.ascontiguousarray(each, np.float64) for each in (e.mass, e.gravity))
    bodies, nodes = np.ascontiguousarray(bodies, np.int64), np.ascontiguousarray(e.starts, np.int32)
    x, v = (np.ascontiguousarray(each, np.result_type(x, v)) for each in (x, v))
    arrays = (each.ctypes.data for each in (bodies, balance, nodes, mass, x, v))
    single, inertia = int(x.dtype == np.float32), int(e.inertia)
    library().wf_gpu_start_balances(len(bodies), *arrays, single, gravity.ctypes.data, dt, inertia)
