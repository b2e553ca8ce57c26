# SPDX-License-Identifier: MIT
"""NVIDIA's run-time compiler by itself (package nvidia-cuda-nvrtc): it needs no GPU and no driver."""

import ctypes
import hashlib
import json
import os
from functools import cache
from importlib import metadata
from pathlib import Path

from protocol.process.cache_folder import cache_folder

ROOT = Path(__file__).resolve().parents[2]
HEADERS = ("sim_server", "precond_worker", "tests/backends")  # where a text may include from


def library() -> ctypes.CDLL | None:
    """libnvrtc as installed by pip, or None."""
    try:
        files = metadata.files("nvidia-cuda-nvrtc") or []
    except metadata.PackageNotFoundError:
        return None
    found = [f for f in files if f.name.startswith("libnvrtc.so")]
    return ctypes.CDLL(str(found[0].locate())) if found else None


def arch(name: str, fast: str = "mid", whole: bool = True) -> list[str]:
    """Options for a text in every precision: sm_90 as a run compiles it, others with less optimization, which is most
    of a compilation's time. They show that the text and its instructions are there too.

    whole: False for less optimization on sm_90, too. fast: min, mid or max; at max calls stay calls, and ptxas warns of
    the stack of templates that call themselves.
    """
    return [f"-arch={name}", *([] if whole and name == "sm_90" else [f"--Ofast-compile={fast}"])]


def compiled(nvrtc: ctypes.CDLL, source: Path, options: list[str]) -> tuple[bytes, str]:
    """Machine code of a text (empty if it was refused), and what the compiler said.

    The same is compiled once on a machine, whatever folder the checkout lies in; kept where kernels for the CPU are.
    """
    text = source.read_bytes()
    words = [option.replace(str(ROOT), "") for option in options]
    key = hashlib.sha256(b"\0".join([text, *(w.encode() for w in words), _surroundings()])).hexdigest()[:32]
    return _read(key) or _kept(key, *_compiled(nvrtc, source.name, text, [o.encode() for o in options]))


@cache
def _surroundings() -> bytes:
    """What else machine code depends on: the compiler and the headers, which stay while tests run."""
    files = sorted(p for folder in HEADERS for p in (ROOT / folder).rglob("*") if p.suffix in (".h", ".cuh"))
    return b"\0".join([metadata.version("nvidia-cuda-nvrtc").encode(), *(p.read_bytes() for p in files)])


def _read(key: str) -> tuple[bytes, str] | None:
    try:
        said, _, code = (cache_folder() / "nvrtc" / key).read_bytes().partition(b"\n")
    except OSError:
        return None
    return code, json.loads(said)


def _kept(key: str, code: bytes, said: str) -> tuple[bytes, str]:
    folder = cache_folder() / "nvrtc"
    folder.mkdir(parents=True, exist_ok=True)
    whole = folder / f"{key}.{os.getpid()}"
    whole.write_bytes(json.dumps(said).encode() + b"\n" + code)
    whole.replace(folder / key)
    return code, said


def _compiled(nvrtc: ctypes.CDLL, name: str, text: bytes, options: list[bytes]) -> tuple[bytes, str]:
    program = ctypes.c_void_p()
    words = (ctypes.c_char_p * len(options))(*options)
    assert nvrtc.nvrtcCreateProgram(ctypes.byref(program), text, name.encode(), 0, None, None) == 0
    refused = nvrtc.nvrtcCompileProgram(program, len(options), words)
    said = _text(nvrtc.nvrtcGetProgramLogSize, nvrtc.nvrtcGetProgramLog, program)
    code = b"" if refused else _text(nvrtc.nvrtcGetCUBINSize, nvrtc.nvrtcGetCUBIN, program)
    nvrtc.nvrtcDestroyProgram(ctypes.byref(program))
    return code, said.rstrip(b"\0").decode()


def _text(size_of, get, program) -> bytes:
    size = ctypes.c_size_t()
    assert size_of(program, ctypes.byref(size)) == 0
    buffer = ctypes.create_string_buffer(size.value)
    assert get(program, buffer) == 0
    return buffer.raw
