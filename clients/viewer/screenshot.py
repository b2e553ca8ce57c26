# SPDX-License-Identifier: MIT
"""A screenshot of the rerun viewer in its headless mode, for which a software Vulkan driver is enough."""

from __future__ import annotations

import os
import shlex
import tempfile
import time
from pathlib import Path

from clients.errors import ClientError
from clients.viewer.rerun_viewer import free_port, viewer_binary

ATTEMPTS = 3
SIZE = "1280x800"
DRIVER_PLACES = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d", "/usr/local/share/vulkan/icd.d")


def has_vulkan_driver() -> bool:
    """True if a driver is registered with the Vulkan loader, as mesa-vulkan-drivers does."""
    if any(os.environ.get(name) for name in ("VK_DRIVER_FILES", "VK_ICD_FILENAMES")):
        return True
    return any(list(Path(place).glob("*.json")) for place in DRIVER_PLACES)


def screenshot(rrd: Path, step: int) -> bytes:
    """Returns a PNG of a recording at a step. Starts several viewers in turn, as one times out on a busy machine.

    Raises ClientError with the last reason.
    """
    reason = ""
    for _ in range(ATTEMPTS):
        with tempfile.TemporaryDirectory() as folder:
            try:
                return _attempt(rrd, step, Path(folder))
            except Exception as error:  # the experimental interface raises many kinds
                panic = _panic(Path(folder) / "log")
                reason = panic or (str(error).splitlines() or [type(error).__name__])[0]
        if panic:
            break  # a driver that does not work fails again
    raise ClientError(f"no screenshot from rerun: {reason}")


def _attempt(rrd: Path, step: int, folder: Path) -> bytes:
    from rerun.experimental import ViewerClient

    wrapper = folder / "rerun"
    binary = shlex.quote(str(viewer_binary()))
    # spawn() has no argument for the address and would listen everywhere; log lines would pop up in the picture.
    wrapper.write_text(
        "#!/bin/sh\n"
        f'export RUST_LOG=off XDG_RUNTIME_DIR="${{XDG_RUNTIME_DIR:-{folder}}}"\n'
        f'exec {binary} "$@" --bind 127.0.0.1 --window-size {SIZE} 2> {folder}/log\n'
    )
    wrapper.chmod(0o700)
    with ViewerClient.spawn(headless=True, port=free_port(), executable_path=str(wrapper)) as viewer:
        viewer.open(str(rrd.resolve()))
        _wait_until_loaded(viewer)
        viewer.set_time("step", sequence=step, play_state="paused")
        return _settled(viewer)


def _panic(log: Path) -> str:
    """Returns the line of a crash of the viewer, e.g. of a Vulkan driver that is registered but does not work."""
    text = log.read_text(errors="replace") if log.exists() else ""
    return next((line for line in text.splitlines() if "panicked at" in line), "")


def _wait_until_loaded(viewer) -> None:
    deadline = time.monotonic() + 30
    while viewer.get_state().loading:
        if time.monotonic() > deadline:
            raise TimeoutError("the viewer did not load the recording in 30 s")
        time.sleep(0.2)


def _settled(viewer) -> bytes:
    """Takes screenshots until two are equal: axes and camera move for a moment after the time was set."""
    last = viewer.take_screenshot()
    for _ in range(10):
        time.sleep(0.5)
        shot = viewer.take_screenshot()
        if shot == last:
            break
        last = shot
    return last
