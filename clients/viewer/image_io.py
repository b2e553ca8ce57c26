# SPDX-License-Identifier: MIT
"""Formats of image files, chosen by their suffix."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Literal

from clients.errors import BadInput, ClientError
from protocol.process.extras import to_install

Kind = Literal["PNG", "JPEG"]
SUFFIXES: dict[str, Kind] = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}
QUALITY = 92  # of 100: edges of surfaces and thin curves stay clean


def kind_of(to: Path) -> Kind:
    """Returns the format of a file by its suffix. Raises BadInput."""
    kind = SUFFIXES.get(to.suffix.lower())
    if kind is None:
        raise BadInput(f"--screenshot {to}: the suffix is {to.suffix!r}; allowed are {', '.join(SUFFIXES)}")
    return kind


def encoded(png: bytes, kind: Kind) -> bytes:
    """Converts a PNG to the bytes of a file of this format. Raises ClientError without Pillow."""
    if kind == "PNG":
        return png
    try:
        from PIL import Image
    except ImportError:
        advice = f"{to_install('view')}, or ask for a .png"
        raise ClientError(f"Pillow is not installed, of the extra view: {advice}") from None
    file = BytesIO()
    with Image.open(BytesIO(png)) as picture:
        picture.convert("RGB").save(file, kind, quality=QUALITY)
    return file.getvalue()
