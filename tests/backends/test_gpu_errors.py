# SPDX-License-Identifier: MIT
"""What is said where there is no usable GPU, or not enough of it; with a package that plays CuPy."""

import subprocess
import sys
import types
from pathlib import Path

import pytest

from sim_server.backends.compiler import CompileError
from sim_server.backends.gpu import device
from sim_server.errors import DeviceError
from sim_server.startup.device import choose_device

ROOT = Path(__file__).parents[2]


class CUDARuntimeError(RuntimeError):
    pass


class OutOfMemoryError(MemoryError):
    pass


class CompileException(Exception):
    pass


def fake(devices: int | Exception = 1, capability: str = "90") -> types.ModuleType:
    """As much of CuPy as is asked before anything is made."""

    def count() -> int:
        if isinstance(devices, Exception):
            raise devices
        return devices

    cp = types.ModuleType("cupy")
    cp.cuda = types.SimpleNamespace(  # type: ignore[attr-defined]
        runtime=types.SimpleNamespace(
            getDeviceCount=count, CUDARuntimeError=CUDARuntimeError, memGetInfo=lambda: (2_000_000_000, 8_000_000_000)
        ),
        Device=lambda: types.SimpleNamespace(compute_capability=capability),
        memory=types.SimpleNamespace(OutOfMemoryError=OutOfMemoryError),
        compiler=types.SimpleNamespace(CompileException=CompileException),
    )
    return cp


@pytest.fixture
def cupy(monkeypatch):
    """Puts a package in CuPy's place."""

    def put(package: types.ModuleType | None) -> None:
        monkeypatch.setitem(sys.modules, "cupy", package)
        device.cupy.cache_clear()

    yield put
    device.cupy.cache_clear()


MISSING = [
    (None, r"CuPy is not usable \(.*cupy.*\); .*-m pip install -e '.*\[gpu\]'"),
    (0, "sees no NVIDIA device"),
    (
        CUDARuntimeError("cudaErrorInsufficientDriver: CUDA driver version is insufficient for CUDA runtime version"),
        "no NVIDIA driver, or it is too old for this CuPy .*Update the driver, or install",
    ),
    (CUDARuntimeError("cudaErrorNoDevice: no CUDA-capable device is detected"), "sees no NVIDIA device .*nvidia-smi"),
    (CUDARuntimeError("cudaErrorUnknown: unknown error"), "does not answer .*nvidia-smi"),
]


def test_an_old_gpu_is_refused(cupy):
    cupy(fake(1, "75"))
    with pytest.raises(DeviceError, match=r"compute capability 7\.5, allowed: 8 and above"):
        device.cupy()


@pytest.mark.parametrize(
    ("found", "text"), MISSING, ids=["no cupy", "none visible", "old driver", "no device", "other"]
)
def test_without_a_gpu_one_message_says_what_to_do(cupy, found, text):
    cupy(None if found is None else fake(found))
    with pytest.raises(DeviceError, match=text) as raised:
        device.cupy()
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("found", "text"), MISSING, ids=["no cupy", "none visible", "old driver", "no device", "other"]
)
def test_auto_goes_on_with_the_cpu_and_says_why_in_one_line(cupy, found, text, monkeypatch):
    cupy(None if found is None else fake(found))
    monkeypatch.setattr("sim_server.startup.device.nvidia_device", lambda: True)
    said: list[str] = []
    assert choose_device("auto", said.append) == "cpu"
    assert len(said) == 1
    assert said[0].startswith("on the CPU; no GPU: ")
    assert "\n" not in said[0]


@pytest.mark.parametrize("installed", [None, fake(0)], ids=["no cupy", "cupy"])
def test_auto_says_nothing_of_gpus_where_there_is_none(cupy, installed, monkeypatch):
    cupy(installed)
    monkeypatch.setattr("sim_server.startup.device.nvidia_device", lambda: False)
    said: list[str] = []
    assert choose_device("auto", said.append) == "cpu"
    assert said == []


def test_auto_takes_a_gpu_that_is_there_and_says_nothing(cupy, monkeypatch):
    cupy(fake())
    monkeypatch.setattr("sim_server.startup.device.nvidia_device", lambda: True)
    said: list[str] = []
    assert choose_device("auto", said.append) == "gpu"
    assert [choose_device(d, said.append) for d in ("cpu", "gpu")] == ["cpu", "gpu"]
    assert said == []


@pytest.mark.parametrize(
    "error",
    [
        OutOfMemoryError("Out of memory allocating 5,000,000,000 bytes (allocated so far: 1,000 bytes)."),
        CUDARuntimeError("cudaErrorMemoryAllocation: out of memory"),
    ],
)
def test_a_scene_that_does_not_fit_names_what_it_needs_and_what_is_free(cupy, error):
    cupy(fake())
    with (
        pytest.raises(DeviceError, match=r"2\.00 of 8\.00 GB are free\. Fewer or smaller objects") as raised,
        device.building(),
    ):
        raise error
    assert str(error) in str(raised.value)


def test_other_errors_while_building_are_left_as_they_are(cupy):
    cupy(fake())
    with pytest.raises(KeyError), device.building():
        raise KeyError("x")


def test_a_kernel_that_does_not_compile_is_named_with_the_first_error(cupy):
    cupy(fake())

    class Module:
        @staticmethod
        def get_function(name: str) -> None:
            raise CompileException("push.cu(3): warning: odd\npush.cu(7): error: identifier nonsense\n1 error detected")

    with pytest.raises(CompileError, match=r"^push.cu does not compile for this GPU: push.cu\(7\): error: .*nonsense$"):
        device.compiled("push.cu", Module, "push")


def test_the_command_ends_with_code_2_and_one_line():
    found = subprocess.run(
        [sys.executable, "-c", "import sys; sys.modules['cupy'] = None; from sim_server.cli import main; main()",
         "deploy/scenes/beam.toml", "--device", "gpu", "--steps", "1"],
        cwd=ROOT, capture_output=True, text=True, timeout=60,
    )  # fmt: skip
    assert found.returncode == 2
    assert len(found.stderr.strip().splitlines()) == 1
    assert "CuPy is not usable" in found.stderr and "pip install" in found.stderr
