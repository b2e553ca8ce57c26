# SPDX-License-Identifier: MIT
"""Tests beside a GPU: skipped, with the reason, where there is none."""

import pytest


@pytest.fixture(autouse=True)
def gpu():
    from sim_server.errors import DeviceError
    from sim_server.gpu.device import cupy

    try:
        cupy()
    except DeviceError as error:
        pytest.skip(str(error))
