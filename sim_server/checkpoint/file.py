# SPDX-License-Identifier: MIT
"""The form of a checkpoint: an .npz file without pickled objects, its manifest (JSON, UTF-8) among the arrays."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.channels import CHANNELS
from sim_server.errors import InputError

FORMAT, VERSION = "warpfactor checkpoint", 1
MANIFEST = "manifest.json"
LARGEST = CHANNELS["checkpoint"].limit - (1 << 16)  # bytes of a file, which travels in one message
UNPACKED = 8 << 30  # bytes of its arrays, at most
ENTRIES = 1 << 20  # arrays


@dataclass
class Checkpoint:
    """A manifest (JSON types) and arrays by name."""

    manifest: dict[str, Any]
    arrays: dict[str, NDArray[Any]] = field(default_factory=dict)

    def to_bytes(self) -> bytes:
        """Returns the file. Raises ValueError if it is larger than a message may be."""
        manifest = {"format": FORMAT, "version": VERSION, **self.manifest}
        text = np.frombuffer(json.dumps(manifest, allow_nan=True).encode(), np.uint8)
        file = io.BytesIO()
        arrays: dict[str, Any] = {MANIFEST: text, **self.arrays}
        np.savez_compressed(file, **arrays)
        if file.tell() > LARGEST:
            raise ValueError(f"the checkpoint has {file.tell() >> 20} MiB: at most {LARGEST >> 20} MiB")
        return file.getvalue()

    def array(self, name: str, dtype: Any, shape: tuple[int, ...] | None = None) -> NDArray[Any]:
        """Returns an array of this type, and shape if it is given. Raises InputError."""
        if name not in self.arrays:
            raise InputError(f"array {name!r} is missing")
        found = self.arrays[name]
        if found.dtype != np.dtype(dtype) or (shape is not None and found.shape != shape):
            wanted = f"{np.dtype(dtype)} of shape {shape}" if shape is not None else f"{np.dtype(dtype)}"
            raise InputError(f"array {name!r} is {found.dtype} of shape {found.shape}; expected: {wanted}")
        return found


def read(path: Path) -> Checkpoint:
    """Reads a checkpoint file. Raises InputError, which names the file."""
    try:
        size = path.stat().st_size
        if size > LARGEST:
            raise InputError(f"{size >> 20} MiB: a checkpoint has at most {LARGEST >> 20} MiB")
        return from_bytes(path.read_bytes())
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from None
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def from_bytes(data: bytes) -> Checkpoint:
    """Reads a checkpoint. Raises InputError."""
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            entries = archive.infolist()
            if len(entries) > ENTRIES or sum(e.file_size for e in entries) > UNPACKED:
                raise InputError(f"more than {ENTRIES} arrays or {UNPACKED >> 30} GiB unpacked")
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (zipfile.BadZipFile, ValueError, KeyError, EOFError, OSError) as error:
        raise InputError(f"no checkpoint, or a damaged one: {error}") from None
    text = arrays.pop(MANIFEST, None)
    if text is None or text.dtype != np.uint8:
        raise InputError(f"no checkpoint: it has no {MANIFEST}")
    try:
        manifest = json.loads(text.tobytes())
    except ValueError as error:
        raise InputError(f"{MANIFEST}: {error}") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise InputError(f"{MANIFEST}: format is not {FORMAT!r}")
    if manifest.get("version") != VERSION:
        raise InputError(f"{MANIFEST}: version = {manifest.get('version')!r}: this server reads {VERSION}")
    return Checkpoint(manifest, arrays)
