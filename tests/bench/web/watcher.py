# SPDX-License-Identifier: MIT
"""What a tab shows, noted in the tab itself: when positions of a surface that has moved were drawn."""

import time
from typing import Any

from tests.support.browser import choose_colour, open_page

STILL, LONGEST = 0.5, 10.0  # s without motion before the pointer jumps, and that this may take at most
MOVED = 1e-3  # m, of a coordinate between two frames: what counts as motion

# three.js gives new positions to the graphics driver in the task that draws the frame with them; the callback before
# the next frame is the first to run after it.
WATCH = f"""
window.watch = {{moved: false, shown: 0, begun: 0, answer: null}};
const last = new WeakMap(), upload = WebGL2RenderingContext.prototype.bufferSubData;
WebGL2RenderingContext.prototype.bufferSubData = function (target, offset, data, ...rest) {{
    if (data instanceof Float32Array && target === this.ARRAY_BUFFER) {{
        const buffer = this.getParameter(this.ARRAY_BUFFER_BINDING), before = last.get(buffer);
        if (before !== undefined && before !== data && before.length === data.length)
            for (let k = 0; k < data.length && !watch.moved; k++)
                watch.moved = Math.abs(data[k] - before[k]) > {MOVED};
        last.set(buffer, data);
    }}
    return upload.call(this, target, offset, data, ...rest);
}};
const each = () => {{
    if (watch.moved) {{
        watch.shown += 1;
        watch.moved = false;
        if (watch.answer) watch.answer(performance.now() - watch.begun);
        watch.answer = null;
    }}
    requestAnimationFrame(each);
}};
requestAnimationFrame(each);
"""
JUMP = """
([x, y]) => new Promise((resolve) => {
    watch.begun = performance.now();
    watch.answer = resolve;
    setTimeout(() => resolve(-1), 5000);
    const mouse = {pointerId: 1, pointerType: "mouse", isPrimary: true, buttons: 1, bubbles: true};
    window.dispatchEvent(new PointerEvent("pointermove", {clientX: x, clientY: y, ...mouse}));
})
"""


def watched(browser: Any, address: str, size: dict[str, int] | None = None) -> Any:
    """Opens a tab that notes what it shows, its surface in one colour: so it is one mesh that keeps its triangles."""
    tab = open_page(browser, address, size, WATCH)
    choose_colour(tab, "plain")
    return tab


def still(tab: Any) -> None:
    """Waits until nothing has moved for a while."""
    end, before, since = time.monotonic() + LONGEST, frames(tab), time.monotonic()
    while time.monotonic() < min(end, since + STILL):
        time.sleep(0.05)
        if (now := frames(tab)) != before:
            before, since = now, time.monotonic()


def jump(tab: Any, x: float, y: float) -> float:
    """Moves the pointer, which holds a body, in one event; returns the time until motion shows [ms], -1: never."""
    return float(tab.evaluate(JUMP, [x, y]))


def frames(tab: Any) -> int:
    """Returns how many frames have shown motion so far."""
    return int(tab.evaluate("() => watch.shown"))
