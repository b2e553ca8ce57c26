# SPDX-License-Identifier: MIT
"""NVIDIA's run-time compiler by itself (package nvidia-cuda-nvrtc): it needs no GPU and no driver."""

import ctypes
from importlib import metadata
from pathlib import Path

_made: dict[tuple[bytes, ...], tuple[bytes, str]] = {}  # by the text and the options; headers stay while tests run


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
    """Machine code of a text (empty if it was refused), and what the compiler said. The same is compiled once."""
    text, encoded = source.read_bytes(), [o.encode() for o in options]
    key = (text, *encoded)
    if key not in _made:
        _made[key] = _compiled(nvrtc, source.name, text, encoded)
    return _made[key]


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
