# SPDX-License-Identifier: MIT
"""A GPU that is not there, or cannot be used: one line that says so. And the kernels' text compiles without one."""

import sys
from types import SimpleNamespace

import pytest

from precond_worker import cli
from precond_worker.errors import DeviceUnusable
from precond_worker.factorization.factorize import Analysis
from precond_worker.gpu import device
from tests.support import nvrtc
from tests.worker.block_matrices import pattern


class CUDARuntimeError(RuntimeError):
    pass


def installed(count: int | Exception = 1, compiler: Exception | None = None) -> SimpleNamespace:
    """A cupy with so many devices and a compiler that raises."""

    def devices() -> int:
        if isinstance(count, Exception):
            raise count
        return count

    def module(**_: object) -> SimpleNamespace:
        if compiler is not None:
            raise compiler
        return SimpleNamespace(get_function=lambda kernel: kernel)

    runtime = SimpleNamespace(
        CUDARuntimeError=CUDARuntimeError,
        getDeviceCount=devices,
        getDeviceProperties=lambda number: {"name": b"Test GPU"},
    )
    attributes = {"SingleToDoublePrecisionPerfRatio": 64}
    cuda = SimpleNamespace(runtime=runtime, Device=lambda: SimpleNamespace(id=0, attributes=attributes))
    return SimpleNamespace(cuda=cuda, RawModule=module)


@pytest.fixture(autouse=True)
def forgotten():
    """What an earlier test has found out about the device."""
    for cached in (device.cupy, device.kernels, device.best_precision):
        cached.cache_clear()
    yield
    for cached in (device.cupy, device.kernels, device.best_precision):
        cached.cache_clear()


OBSTACLES = {
    "no CuPy": (None, r"CuPy is not usable \(.*cupy.*\); .*-m pip install -e '.*\[gpu\]'"),
    "no driver": (
        installed(CUDARuntimeError("cudaErrorInsufficientDriver")),
        r"no NVIDIA driver, or .* too old.*Insuff",
    ),
    "no device": (installed(0), r"sees no NVIDIA device \(is CUDA_VISIBLE_DEVICES empty\?\)"),
    "no compiler": (installed(1, RuntimeError("libnvrtc.so\nmore")), r"does not compile for this GPU: libnvrtc\.so$"),
}
obstacles = pytest.mark.parametrize(("module", "text"), OBSTACLES.values(), ids=OBSTACLES.keys())


@obstacles
def test_an_unusable_gpu_is_named_in_one_line(module, text, monkeypatch):
    monkeypatch.setitem(sys.modules, "cupy", module)
    with pytest.raises(DeviceUnusable, match=text) as caught:
        device.try_out()
    assert "\n" not in str(caught.value)
    with pytest.raises(DeviceUnusable, match=text):
        Analysis(*pattern(2, [[0, 1]]), "gpu")


@obstacles
def test_the_worker_ends_with_code_2_or_takes_the_cpu(module, text, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "cupy", module)
    monkeypatch.setattr(cli, "nvidia_device", lambda: True)
    with pytest.raises(cli.typer.Exit) as ended:
        cli.chosen_library("gpu", "auto")
    assert ended.value.exit_code == 2
    assert capsys.readouterr().err.startswith("precond-worker: --device gpu: ")
    assert cli.chosen_library("auto", "auto") == "auto"
    assert "--device auto takes the CPU: " in capsys.readouterr().err


@obstacles
def test_the_worker_says_nothing_of_gpus_where_there_is_none(module, text, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "cupy", module)
    monkeypatch.setattr(cli, "nvidia_device", lambda: False)
    assert cli.chosen_library("auto", "auto") == "auto"
    assert capsys.readouterr().err == ""


def test_the_worker_takes_the_gpu_where_there_is_one(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "cupy", installed())
    monkeypatch.setattr(cli, "nvidia_device", lambda: True)
    assert cli.chosen_library("auto", "auto") == cli.chosen_library("gpu", "auto") == "gpu"
    assert cli.chosen_library("gpu", "float64") == "gpu-float64"
    assert cli.chosen_library("cpu", "auto") == "auto"
    assert cli.library_title("gpu") == "Test GPU, float32", "float64 is slow there"
    assert cli.library_title("gpu-float64") == "Test GPU, float64"
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("choice", "text"),
    [
        (("tpu", "auto"), "--device tpu: allowed are auto, cpu, gpu"),
        (("gpu", "float16"), "--precision float16: allowed are auto, float32, float64"),
    ],
)
def test_other_words_are_refused(choice, text, capsys):
    with pytest.raises(cli.typer.Exit) as ended:
        cli.chosen_library(*choice)
    assert ended.value.exit_code == 2
    assert text in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("arch", ["sm_80", "sm_90"])
@pytest.mark.parametrize(("real", "value"), [("double", "float"), ("float", "float")])
def test_the_kernels_compile_for_gpus(arch, real, value):
    """By NVRTC, which needs no GPU and no driver; what it says counts as a failure too."""
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    options = [*nvrtc.arch(arch, "max", whole=real == "double"), "-std=c++17", f"-Dreal={real}", f"-DValue={value}"]
    code, said = nvrtc.compiled(library, device.SOURCE, options)
    assert len(code) > 1000 and not said, said
