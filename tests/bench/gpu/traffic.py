# SPDX-License-Identifier: MIT
"""Bytes that a step has to move, counted from sizes: what is over the bandwidth of the memory is a floor of its time.

Each array is counted once per pass over it, as if nothing stayed in caches; what does stay there makes small bodies
faster than this floor says (an H200 keeps about 25 MB close by).
"""

from dataclasses import dataclass

INDEX = 4  # bytes


@dataclass(frozen=True)
class Size:
    """Of a scene. blocks: 3x3 of A; upper: those on and above its diagonal; factor: bytes an application reads; real:
    bytes of a number of the matrix and the vectors."""

    nodes: int
    tets: int
    blocks: int
    upper: int
    factor: int
    real: int = 8


# Passes over vectors of 3 numbers a node in an iteration: product reads p, writes q; y += a p reads y and p, writes y;
# r -= a q reads r and q, writes r; application reads r, writes z; p = z + b p reads z and p, writes p.
PASSES = 13


def matrix(size: Size, iterations: float) -> float:
    """A is written once, read by each product and by that for the residual of the start."""
    values = 9 * size.real * size.blocks
    return values + (iterations + 1) * (values + INDEX * (size.blocks + size.nodes + 1))


def vectors(size: Size, iterations: float) -> float:
    """Of the iteration, and of the start: b, y, q read, r and p written."""
    return (PASSES * iterations + 5) * 3 * size.real * size.nodes


def factor(size: Size, iterations: float) -> float:
    """One application an iteration."""
    return iterations * size.factor


def assembly(size: Size) -> float:
    """Elements, nodes and blocks before the solve, x and v after it; without the values of A.

    An element reads its corners and 12 constants, writes 33 numbers (rotation, scaled gradients, nodal impulses),
    which the nodes' and blocks' lists (4 and 10 pairs) read again; a node reads and writes about 50 numbers, a
    block on or above the diagonal reads four indices.
    """
    element = INDEX * (4 + 4 + 2 * 10) + size.real * (12 + 2 * 33 + 1)
    return element * size.tets + 50 * size.real * size.nodes + 4 * INDEX * size.upper


def step(size: Size, iterations: float) -> dict[str, float]:
    """MB by what they are for, and all of them."""
    parts = {
        "matrix": matrix(size, iterations),
        "vectors": vectors(size, iterations),
        "factor": factor(size, iterations),
        "assembly": assembly(size),
    }
    return {name: bytes / 1e6 for name, bytes in {**parts, "all": sum(parts.values())}.items()}
