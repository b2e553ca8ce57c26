# SPDX-License-Identifier: MIT
"""A headless Chromium for tests, benches and pictures of the page, and where points of the scene are in its window."""

import contextlib
import math
import shutil
import time
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.web.view import View

# WebGL in software, as there may be no GPU; no sandbox, as root may run this, and only our page is opened.
ARGUMENTS = (
    "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage", "--disable-background-timer-throttling", "--disable-renderer-backgrounding",
    "--disable-backgrounding-occluded-windows",
)  # fmt: skip
FIELD_OF_VIEW = math.radians(75)  # of viser's camera, vertical
PATIENCE = 90_000.0  # ms that a step in the browser may take: it draws in software, maybe on a full machine
SIZE = {"width": 900, "height": 480}


def missing() -> str:
    """Returns why there is no browser here; empty if there is one."""
    try:
        import playwright  # noqa: F401
    except ImportError:
        return "playwright is not installed"
    return "" if _chromium() else "no chromium here (Debian: chromium)"


def _chromium() -> str | None:
    return shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


@contextlib.contextmanager
def browser() -> Iterator[Any]:
    """A Chromium without a window."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=_chromium(), args=list(ARGUMENTS))
        try:
            yield started
        finally:
            started.close()


# What WebGL has drawn stays readable.
KEEP = """
const get = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, options) {
    return get.call(this, kind, kind.startsWith("webgl") ? {...options, preserveDrawingBuffer: true} : options);
};
"""
# Closes viser's note about WebGL in software.
NO_NOTES = "() => document.querySelectorAll('.mantine-Notification-root button').forEach((button) => button.click())"
# The charts have canvases too; the scene's is the largest.
CANVAS = """
const canvas = Array.from(document.querySelectorAll("canvas")).reduce(
    (a, b) => a.width * a.height >= b.width * b.height ? a : b);
const box = canvas.getBoundingClientRect();
"""
BOX = f"() => {{ {CANVAS} return [box.x, box.y, box.width, box.height]; }}"
READ = f"""
([x, y, size]) => {{
    {CANVAS}
    const scale = canvas.width / box.width, copy = document.createElement("canvas");
    copy.width = copy.height = size;
    const context = copy.getContext("2d"), half = size / 2;
    context.drawImage(canvas, (x - box.x - half) * scale, (y - box.y - half) * scale, size * scale, size * scale,
                      0, 0, size, size);
    return Array.from(context.getImageData(0, 0, size, size).data);
}}
"""


def pixels(tab: Any, at: tuple[float, float], size: int = 40) -> NDArray[np.int64]:
    """Returns RGBA (size, size, 4) of the scene around a place in the window; what nothing covers is transparent."""
    return np.array(tab.evaluate(READ, [*at, size])).reshape(size, size, 4)


def open_page(browser: Any, address: str, size: dict[str, int] | None = None, script: str = KEEP) -> Any:
    """Opens the page in a tab of its own, and waits until it is connected. script: runs in it before all others."""
    tab = browser.new_page(viewport=size or SIZE)
    tab.set_default_timeout(PATIENCE)
    tab.add_init_script(script)
    tab.goto(address)
    tab.get_by_text("running", exact=True).first.wait_for()
    tab.get_by_text("This tab", exact=True).wait_for()
    tab.wait_for_function(f"() => {{ {CANVAS} return canvas.width * canvas.height > 40_000; }}")
    tab.evaluate(NO_NOTES)
    return tab


def field(tab: Any, label: str) -> Any:
    """Returns the visible input beside a label of the panel."""
    beside = "xpath=ancestor::*[.//input][1]//input[not(@type='hidden')]"
    return tab.locator("label", has_text=label).locator(beside).first


def choose_colour(tab: Any, mode: str) -> None:
    """Has a tab colour its bodies so (clients.web.paint.MODES)."""
    from playwright.sync_api import Error

    chosen, option = field(tab, "colour"), tab.get_by_role("option", name=mode, exact=True)
    deadline = time.monotonic() + PATIENCE / 1000
    while chosen.input_value() != mode:  # events, not places in the window: the panel moves while it is filled
        if time.monotonic() > deadline:
            raise TimeoutError(f"the page still has the colour {chosen.input_value()!r}, not {mode!r}")
        if not option.count():
            chosen.dispatch_event("click")
        with contextlib.suppress(Error):  # the list may close or be drawn anew; then it is asked for again
            option.dispatch_event("click", timeout=3000)


def on_screen(tab: Any, view: View, point: Sequence[float] | NDArray) -> tuple[float, float]:
    """Returns where a point of the scene [m] is in the window of a tab whose camera has not been moved [pixels]."""
    left, top, width, height = tab.evaluate(BOX)
    forward = view.target - view.position
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, view.up)
    right = right / np.linalg.norm(right)
    up = np.cross(right, forward)
    away = np.asarray(point, float) - view.position
    scale = height / 2 / math.tan(FIELD_OF_VIEW / 2) / (away @ forward)
    return (
        float(left + width / 2 + scale * (away @ right)),
        float(top + height / 2 - scale * (away @ up)),
    )
