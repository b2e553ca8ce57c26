# SPDX-License-Identifier: MIT
"""Exports a log as a film (.mp4, H.264), drawn by the processor alone and encoded by the ffmpeg of imageio-ffmpeg."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from clients.errors import ClientError
from clients.log.atomic_file import atomic_file
from clients.log.reader import Log
from clients.viewer.film import Angle, Stage

SIZE = (960, 720)  # pixels; both whole multiples of 16, as encoders like it
RATE = 30.0  # pictures in a second
ANGLE = Angle(nearness=0.95)  # bodies and the caption below


def write_mp4(
    log: Log,
    names: Sequence[str],
    to: Path,
    progress: Callable[[float], None] = lambda _: None,
    size: tuple[int, int] = SIZE,
) -> None:
    """Writes the whole log in real time, as Stage draws it. Raises BadInput, ClientError if ffmpeg fails, OSError."""
    import imageio_ffmpeg

    stage = Stage(log, size, ANGLE, names)
    times = np.arange(stage.begin, stage.end + 1e-9, 1 / RATE)
    total = sum(len(log.object_log(name).frames) for name in names)
    with atomic_file(to) as part:
        part.touch()  # a bad path is reported before the first picture
        film = imageio_ffmpeg.write_frames(
            str(part), size, fps=RATE, quality=7, macro_block_size=1, ffmpeg_log_level="error",
            output_params=["-movflags", "+faststart"],
        )  # fmt: skip
        try:
            film.send(None)
            for k, time in enumerate(times):
                film.send(stage.draw(float(time)).tobytes())
                progress(total * (k + 1) / len(times))
        except OSError as error:  # it ended early; its words are many lines
            said = next((line for line in reversed(str(error).splitlines()) if line.strip()), "ffmpeg failed")
            raise ClientError(f"{to}: cannot be written: {said.strip()}") from None
        finally:
            film.close()
