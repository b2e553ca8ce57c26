# SPDX-License-Identifier: MIT
"""Hostile inputs by seed: scenes and messages changed by structure, meshes and logs by bytes and numbers."""

import copy
import random
import struct
import tempfile
import tomllib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import meshio
import numpy as np
from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

from protocol import messages_pb2
from protocol.channels import PROTOCOL
from sim_server.mesh import bar
from tests.protocol.wire_samples import sample, types
from tests.sample_run import record

ROOT = Path(__file__).resolve().parents[2]
FORMATS = (
    (".vtk", "vtk"),
    (".vtu", "vtu"),
    (".msh", "gmsh"),
    (".msh", "gmsh22"),
    (".mesh", "medit"),
    (".inp", "abaqus"),
)
NUMBERS = (0.0, -1.0, 1e308, -1e308, 5e-324, 1e-30, float("nan"), float("inf"), float("-inf"), 0.5, 3.0)
INTEGERS = (0, 1, -1, 2**31 - 1, 2**31, -(2**31), 2**63 - 1, 10**30, 7)
TEXTS = ("", "x", "a/b", "../..", "\x1b[31m", "é" * 40, "X < 0.5", "__import__('os')", "a" * 5000, "beam", "tip", "*")
VERBS = ("push", "grab", "move", "release", "pause", "resume", "step", "set", "reset", "reload", "save", "place", "cut")
PLACES = ("object", "mesh", "effects", "solver", "integrator", "obstacle")


def value(rng: random.Random, old: Any = None) -> Any:
    """A value that nobody expects."""
    if isinstance(old, int | float) and not isinstance(old, bool) and rng.random() < 0.4:
        return old * rng.choice((-1, 0, 2, 0.5, 1e-6, 1e6))
    pick = rng.randrange(7)
    if pick < 3:
        return rng.choice((NUMBERS, INTEGERS, TEXTS)[pick])
    if pick == 3:
        return [value(rng) for _ in range(rng.randrange(3))]
    return ({}, {rng.choice(TEXTS): rng.random()}, rng.random() < 0.5)[pick - 4]


def _tables(node: Any) -> list[Any]:
    inner = node.values() if isinstance(node, dict) else node if isinstance(node, list) else ()
    return ([node] if isinstance(node, dict | list) and node else []) + [t for each in inner for t in _tables(each)]


@cache
def scenes() -> list[dict[str, Any]]:
    """Scenes of the repository whose bodies are small and made from a table."""
    found = [tomllib.loads(path.read_text()) for path in sorted((ROOT / "deploy" / "scenes").glob("*.toml"))]
    return [s for s in found if "msh" not in str(s)]


def scene(rng: random.Random) -> bytes:
    """A scene of the repository with one to three values, keys or whole tables changed; at times its bytes, too."""
    tables = copy.deepcopy(rng.choice(scenes()))
    for _ in range(rng.choice((1, 1, 2, 3))):
        place = rng.choice(_tables(tables))
        key = rng.choice(list(place) if isinstance(place, dict) else range(len(place)))
        kind = rng.randrange(5)
        if kind == 0:
            del place[key]
        elif kind == 1 and isinstance(place, dict):
            place[rng.choice(TEXTS + PLACES)] = place[key]
        elif kind == 2:
            place[key] = copy.deepcopy(rng.choice(_tables(rng.choice(scenes()))))
        else:
            place[key] = value(rng, place[key])
        if not _tables(tables):
            break
    text = "".join(f"{_text(str(key))} = {_toml(v)}\n" for key, v in tables.items())
    data = text.encode(errors="replace")
    return changed(rng, data) if rng.random() < 0.15 else data


def _toml(node: Any) -> str:
    if isinstance(node, dict):
        return "{ " + ", ".join(f"{_text(str(k))} = {_toml(v)}" for k, v in node.items()) + " }"
    if isinstance(node, list | tuple):
        return "[" + ", ".join(map(_toml, node)) + "]"
    if isinstance(node, str):
        return _text(node)
    return str(node).lower() if isinstance(node, bool | int | float) else _text(str(node))


def _text(text: str) -> str:
    return '"' + "".join(c if c.isprintable() and c not in '"\\' else f"\\u{ord(c):04x}" for c in text) + '"'


def changed(rng: random.Random, data: bytes) -> bytes:
    """Flips bits, cuts out, doubles and overwrites some bytes; at times with lengths that are much too large."""
    out = bytearray(data)
    for _ in range(rng.randint(1, 6)):
        at = rng.randrange(len(out) + 1)
        kind = rng.randrange(5)
        if kind == 0 and at < len(out):
            out[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            del out[at : at + rng.choice((1, 4, 64, 1000))]
        elif kind == 2:
            out[at:at] = out[max(0, at - 32) : at]
        elif kind == 3:
            out[at : at + 8] = struct.pack("<Q", rng.choice((0, 1, 2**31, 2**32 - 1, 2**60, 2**64 - 1)))
        else:
            out[at : at + 1] = rng.randbytes(rng.randrange(9))
    return bytes(out)


@cache
def meshes() -> list[tuple[str, bytes]]:
    """(suffix, bytes) of a box in each format."""
    box, found = bar([2, 2, 3], [1, 1, 2]), []
    with tempfile.TemporaryDirectory() as folder:
        for suffix, form in FORMATS:
            path = Path(folder) / f"box{suffix}"
            extra = {"binary": False} if form != "abaqus" and form != "medit" else {}
            for options in ({}, extra) if extra else ({},):
                meshio.write(path, meshio.Mesh(box.rest, [("tetra", box.tets)]), form, **options)
                found.append((suffix, path.read_bytes()))
    return found


def mesh(rng: random.Random) -> tuple[str, bytes]:
    """(suffix, bytes): a mesh file with bytes changed, or numbers of its text replaced."""
    suffix, data = rng.choice(meshes())
    if rng.random() < 0.5:
        return suffix, changed(rng, data)
    words = data.split(b" ")
    for _ in range(rng.randint(1, 5)):
        words[rng.randrange(len(words))] = str(rng.choice(NUMBERS + INTEGERS)).encode()
    return suffix, b" ".join(words)


@cache
def logs() -> list[bytes]:
    """A log by each compression."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for kind in ("lz4", "zstd", "none"):
            path = record(Path(folder) / f"{kind}.mcap", 40, compression=kind)
            found.append(path.read_bytes())
    return found


def log(rng: random.Random) -> bytes:
    """A log with bytes changed."""
    return changed(rng, rng.choice(logs()))


def message(rng: random.Random) -> tuple[str, bytes]:
    """(type, bytes): a message whose fields are filled, left out or replaced by what their types allow."""
    name = rng.choice((*types(), *["Command"] * 12, *["FactorPattern"] * 6, "Need", "Obstacle"))
    made = sample(name)
    if name == "FactorPattern" and rng.random() < 0.8:
        made = _pattern()
    _vary(rng, made, 4, 0.2)
    if name == "Command" and rng.random() < 0.9:
        made.verb = rng.choice(VERBS)  # type: ignore[attr-defined]
    data = made.SerializeToString()
    return name, changed(rng, data) if data and rng.random() < 0.2 else data


def _pattern() -> Message:
    """A pattern that is right: two supernodes of a matrix of 6 rows."""
    return messages_pb2.FactorPattern(
        id=1, size=6, supernodes=2, nonzeros=21, permutation=np.arange(6, dtype=np.int32).tobytes(),
        super_start=np.array([0, 3, 6], np.int32).tobytes(), row_start=np.array([0, 6, 9], np.int64).tobytes(),
        rows=np.array([0, 1, 2, 3, 4, 5, 3, 4, 5], np.int32).tobytes(),
    )  # fmt: skip


def _vary(rng: random.Random, made: Message, depth: int, part: float) -> None:
    for field in made.DESCRIPTOR.fields:
        if field.name == "protocol":
            setattr(made, field.name, PROTOCOL if rng.random() < 0.9 else rng.choice((0, 2, 2**32 - 1)))
        elif field.type == FieldDescriptor.TYPE_MESSAGE:
            inner = getattr(made, field.name)
            for each in inner if field.is_repeated else [inner] if made.HasField(field.name) else []:
                if hasattr(each, "DESCRIPTOR") and depth > 0:
                    _vary(rng, each, depth - 1, part)
            if rng.random() < part / 2:
                made.ClearField(field.name)
        elif rng.random() < part:
            made.ClearField(field.name)
            if field.is_repeated:
                getattr(made, field.name).extend(_fitting(rng, field) for _ in range(rng.choice((0, 1, 3, 400))))
            elif rng.random() < 0.8:
                setattr(made, field.name, _fitting(rng, field))


def _fitting(rng: random.Random, field: FieldDescriptor) -> Any:
    """A value that a field can hold."""
    low, high = (-(2**31), 2**31 - 1) if field.cpp_type in (1, 8) else (-(2**63), 2**63 - 1)
    if field.cpp_type in (FieldDescriptor.CPPTYPE_UINT32, FieldDescriptor.CPPTYPE_UINT64):
        low, high = 0, 2**32 - 1 if field.cpp_type == FieldDescriptor.CPPTYPE_UINT32 else 2**64 - 1
    return {
        FieldDescriptor.TYPE_STRING: lambda: rng.choice((*TEXTS, *VERBS)),
        FieldDescriptor.TYPE_BYTES: lambda: rng.randbytes(rng.choice((0, 1, 4, 24, 96))),
        FieldDescriptor.TYPE_BOOL: lambda: rng.random() < 0.5,
        FieldDescriptor.TYPE_DOUBLE: lambda: rng.choice(NUMBERS),
        FieldDescriptor.TYPE_FLOAT: lambda: rng.choice(NUMBERS),
        FieldDescriptor.TYPE_ENUM: lambda: rng.choice((0, 1, 2)),
    }.get(field.type, lambda: min(max(rng.choice(INTEGERS), low), high))()


KINDS: dict[str, Callable[[random.Random], Any]] = {"scene": scene, "mesh": mesh, "log": log, "wire": message}


def made(kind: str, seed: int) -> Any:
    """The input of a seed: the same one each time."""
    return KINDS[kind](random.Random(f"{kind}-{seed}"))
