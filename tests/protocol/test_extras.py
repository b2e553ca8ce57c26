# SPDX-License-Identifier: MIT
"""Advice on what to install: a command that works here. And whether anybody is to be told of GPUs."""

import ctypes
import re
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from protocol.process import extras, nvidia
from protocol.process.extras import to_install

ROOT = Path(__file__).parents[2]


def test_a_checkout_is_installed_from_its_files():
    assert to_install("view") == f"{sys.executable} -m pip install -e '{ROOT}[view]'"


def test_without_a_checkout_the_packages_of_the_extra_are_named(monkeypatch):
    lines = ["numpy>=2", 'cupy-cuda13x[ctk]>=14; extra == "gpu"', "rerun-sdk==0.41.*; extra == 'view'"]
    monkeypatch.setattr(extras, "CHECKOUT", Path("/nowhere"))
    monkeypatch.setattr(extras, "requires", lambda package: lines)
    assert to_install("gpu") == f"{sys.executable} -m pip install 'cupy-cuda13x[ctk]>=14'"
    assert to_install("view") == f"{sys.executable} -m pip install 'rerun-sdk==0.41.*'"


def test_nobody_is_advised_to_install_a_name_that_no_index_has():
    folders = ("protocol", "sim_server", "precond_worker", "clients", "deploy", "docs", "tests")
    found = [*ROOT.glob("*.*"), *(path for folder in folders for path in (ROOT / folder).rglob("*"))]
    texts = [path for path in found if path.suffix in (".py", ".md", ".sh", ".toml") or path.name == "run"]
    assert len(texts) > 100
    advice = re.compile(r"pip[\w /.-]* install [^\n]*?[ '\"]warpfactor\b")
    assert [str(path) for path in texts if path.is_file() and advice.search(path.read_text())] == []


def driver(init: int, count: int = 0, error: int = 0) -> SimpleNamespace:
    """As much of libcuda.so.1 as is asked."""

    def devices(found: object) -> int:
        ctypes.cast(found, ctypes.POINTER(ctypes.c_int)).contents.value = count  # type: ignore[arg-type]
        return error

    return SimpleNamespace(cuInit=lambda flags: init, cuDeviceGetCount=devices)


@pytest.mark.parametrize(
    ("found", "there"),
    [
        (None, False), (driver(0, 0), False), (driver(0, 2), True),
        (driver(100), False),  # no device, or CUDA_VISIBLE_DEVICES hides it
        (driver(34), False),  # the library for linking without a driver
        (driver(803), True),  # driver and library do not fit: its owner wants to know
        (driver(0, 0, 999), True),
    ],
    ids=["no driver", "none", "two", "no device", "stub", "mismatch", "unknown"],
)  # fmt: skip
def test_the_driver_is_asked_for_devices(found, there, monkeypatch):
    def load(name: str) -> SimpleNamespace:
        assert name == "libcuda.so.1"
        if found is None:
            raise OSError("cannot open shared object file")
        return found

    monkeypatch.setattr(nvidia, "ctypes", SimpleNamespace(CDLL=load, c_int=ctypes.c_int, byref=ctypes.byref))
    assert nvidia.nvidia_device() is there
