# SPDX-License-Identifier: MIT
"""The structs of the GPU solver stand twice, in C and in NumPy: same names, same order, same sizes."""

import re

import numpy as np
import pytest

from sim_server.backend import HERE
from sim_server.gpu.planned import PLAN
from sim_server.gpu.shares import SHARE
from sim_server.gpu.solver import BODY, RESULT, SOLVE

SIZES = {"int": 4, "unsigned": 4, "float": 4, "double": 8, "long long": 8}
TEXT = (HERE / "gpu/solve.cuh").read_text()


def fields(name: str) -> list[tuple[str, int]]:
    """Names and bytes of a struct's fields, pointers 8."""
    body = re.search(rf"struct (?:__align__\(\d+\) )?{name} \{{(.*?)\}};", TEXT, re.DOTALL)
    assert body, name
    found = []
    for line in re.sub(r"//.*", "", body[1]).split(";"):
        declaration = re.match(r"\s*(?:const )?(long long|struct \w+|[\w<>]+)(\s*\*?)\s*(.*)", line.strip(), re.DOTALL)
        if not line.strip():
            continue
        assert declaration, line
        kind, star, names = declaration.groups()
        for each in re.split(r",\s*", names):
            pointer = "*" in star or each.startswith("*")
            found.append((each.strip("* "), 8 if pointer else SIZES[kind]))
    return found


@pytest.mark.parametrize(
    ("name", "layout"), [("Plan", PLAN), ("Body", BODY), ("Result", RESULT), ("Solve", SOLVE), ("Share", SHARE)]
)
def test_both_sides_agree(name: str, layout: np.dtype) -> None:
    assert layout.names is not None
    ours = [(n, layout[n].itemsize) for n in layout.names]
    assert fields(name) == ours
