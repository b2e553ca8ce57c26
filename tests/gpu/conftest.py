# SPDX-License-Identifier: MIT
"""Tests beside a GPU: left out without an NVIDIA device; skipped, with the reason, where there is no usable one."""

from pathlib import Path

import pytest

from protocol.process.nvidia import nvidia_device


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if nvidia_device():
        return
    here = [item for item in items if item.path.is_relative_to(Path(__file__).parent)]
    if here:
        items[:] = [item for item in items if item not in here]
        config.hook.pytest_deselected(items=here)


@pytest.fixture(autouse=True)
def gpu():
    from sim_server.backends.gpu.device import cupy
    from sim_server.errors import DeviceError

    try:
        cupy()
    except DeviceError as error:
        pytest.skip(str(error))
