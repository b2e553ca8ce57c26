# SPDX-License-Identifier: MIT
"""The energy of bodies on a GPU: its memory, the elastic energy on demand, and the start that all is reckoned from.

Everything but the elastic energy is summed up within the last kernel of a step (account.cuh).
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backend import HERE
from sim_server.energy import CODES, Energies
from sim_server.gpu.device import Gpu, compiled, options
from sim_server.gpu.layouts import ENERGY
from sim_server.gpu.mailbox import library
from sim_server.layouts import BALANCE

WARP, THREADS = 32, 128  # threads; of a thread block of elastic.cu
PARTIAL = np.dtype(
    [(n, "f8") for n in ("kinetic", "gravity", "fallen", "work")]
    + [(n, "f4", 3) for n in ("low", "high")]
    + [("pad", "f8")]
)
POINTERS = ("body", "first", "mass", "force", "spring", "anchor", "free", "partial", "balance", "told", "gravity")
ACCOUNT = np.dtype([(n, "u8") for n in POINTERS] + [(n, "i4") for n in ("bodies", "on_runaway", "inertia", "lanes")])
ELASTIC = np.dtype(
    [(n, "u8") for n in ("energy", "parts", "sum", "step", "balance", "told")]
    + [("capacity", "i4"), ("begins", "i4")]
)  # fmt: skip


def lanes(threads: int, bodies: int) -> int:
    """Threads of a thread block that share the sums of a body: a power of two."""
    return 1 << max(threads // bodies, 1).bit_length() - 1


class DeviceEnergies:
    """Energies of a scene on the device.

    told: host memory (capacity, bodies) of ENERGY that the steps write to. counter: device array (1,) of completed
    steps. params: `account` of the last kernel of a step, but for `lanes`.
    """

    def __init__(self, gpu: Gpu, energies: Energies, told: NDArray[np.uint8], counter: Any, dt: float):
        self._gpu, self._energies, self._dt = gpu, energies, dt
        cp, world = gpu.cp, energies.world
        self._starts = np.array([*(b.first for b in world.bodies), world.nodes], np.int32)
        self._bodies = len(world.bodies)
        self.started = False
        self._balance = cp.asarray(np.frombuffer(energies.balance.tobytes(), np.uint8))
        self._memory: dict[str, Any] = {
            "body": cp.asarray(np.repeat(np.arange(self._bodies, dtype=np.int32), np.diff(self._starts))),
            "first": cp.asarray(self._starts), "mass": gpu.twin(world.mass), "free": gpu.twin(world.free),
            "partial": cp.zeros((world.nodes // WARP + self._bodies + 1) * PARTIAL.itemsize, np.uint8),
            "balance": self._balance, "gravity": gpu.twin(energies.gravity),
        }  # fmt: skip
        if energies.touch is not None:
            self._memory |= {n: gpu.twin(getattr(energies.touch, n)) for n in ("force", "spring", "anchor")}
        self.params = np.zeros((), ACCOUNT)
        for name, array in self._memory.items():
            self.params[name] = array.data.ptr
        self.params["told"] = told.ctypes.data
        self.params["bodies"], self.params["inertia"] = self._bodies, world.inertia
        self.params["on_runaway"] = CODES[energies.on_runaway]
        self._sum = cp.zeros(self._bodies)
        self._launches = self._elastic(told, counter)

    def _elastic(self, told: NDArray[np.uint8], counter: Any) -> list[tuple[Any, Any, NDArray[Any]]]:
        """(what evaluates the energies of the elements, its array, arguments of the sums over them) for each effect."""
        cp = self._gpu.cp
        found = [(e.launch, e.launch.arrays["energy"], self._energies.parts(e)) for e in self._energies.elastic]
        found = found or [(None, cp.zeros(1), np.zeros(self._bodies + 1, np.int32))]
        made = []
        for k, (launch, array, parts) in enumerate(found):
            params, kept = np.zeros((), ELASTIC), cp.asarray(parts)
            self._memory[f"parts{k}"] = kept
            params["energy"], params["parts"], params["sum"] = array.data.ptr, kept.data.ptr, self._sum.data.ptr
            params["step"], params["balance"], params["told"] = (
                counter.data.ptr,
                self._balance.data.ptr,
                told.ctypes.data,
            )
            params["capacity"], params["begins"] = told.nbytes // ENERGY.itemsize // self._bodies, k == 0
            made.append((launch, array, params))
        module = cp.RawModule(
            code=(HERE / "gpu/elastic.cu").read_text(), options=(*options(self._gpu.types), f"-I{HERE / 'gpu'}"),
            backend="nvrtc",
        )  # fmt: skip
        self._function = compiled("elastic.cu", module, "elastic")
        return made

    def launch(self) -> None:
        """Puts the evaluation of the elastic energy of the last step onto the current stream."""
        for launch, _, params in self._launches:
            if launch is not None:
                launch()
            self._function((self._bodies,), (THREADS,), (params,))

    def start(self) -> None:
        """Reckons from the state that is on the device now, before the first step."""
        e, w = self._energies, self._energies.world
        self.launch()
        x, v = (self._gpu.twin(array).get().astype(float) for array in (w.x, w.v))
        balance = np.frombuffer(self._balance.get().tobytes(), BALANCE).copy()
        balance["elastic"] = self._sum.get()
        for body in w.bodies:
            row = balance[body.index : body.index + 1]
            sums = start_sums(w.mass[body.nodes], x[body.nodes], v[body.nodes], e.gravity, self._dt)
            library().wf_gpu_start_balance(row.ctypes.data, sums.ctypes.data, self._dt, int(w.inertia))
        self._balance.set(np.frombuffer(balance.tobytes(), np.uint8))
        self.started = True


def start_sums(
    mass: NDArray[np.float64], x: NDArray[np.float64], v: NDArray[np.float64], gravity: NDArray[np.float64], dt: float
) -> NDArray[np.float64]:
    """Kinetic energy and that of gravity [J], the largest difference of dt v along an axis and the diagonal [m]."""
    stride = float(dt * np.ptp(v, axis=0).max())
    diagonal = float(np.linalg.norm(np.ptp(x, axis=0)))
    return np.array([0.5 * mass @ (v**2).sum(axis=1), -mass @ (x @ gravity), stride, diagonal])
