# SPDX-License-Identifier: MIT
"""Meshes of tetrahedra in a signed distance function: a lattice whose nodes are moved until it fills the shape well.

Tetrahedra of the body-centred cubic lattice (all alike, dihedral angles of 60 and 90 degrees) whose centroid is inside
are taken. Then all nodes move so that the sum of the elements' distortion tr(J^T J) / (3 det(J)^(2/3)), a barrier
against flat elements, and of the squared distances of surface nodes from the shape is least. Flat elements that are
left at the surface are cut off.

Sources: Molino, Bridson, Teran, Fedkiw, A crystalline, red green strategy for meshing highly deformable objects with
tetrahedra, 2003 (lattice, moved nodes); Fu, Liu, Guo, Computing locally injective mappings by advanced MIPS, 2015.
"""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Shape = Callable[[Floats], Floats]  # points (n, 3) [m] to signed distances (n,) [m], negative inside

FACES = np.array([[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]])  # against each corner, normals outward
REGULAR = np.linalg.inv(np.array([[1, 0, 0], [0.5, 0.75**0.5, 0], [0.5, 0.75**0.5 / 3, (2 / 3) ** 0.5]]).T)
FLAT = 150.0  # degrees: largest dihedral angle at the surface of an element that is kept
WEIGHTS = (1.0, 10.0, 100.0, 400.0)  # of squared distances from the shape over the lattice's cell, one after the other
POWER = 3  # of an element's distortion in the sum: the worst ones count most


def mesh(shape: Shape, low: Floats, high: Floats, cell: float) -> tuple[Floats, Ints]:
    """Returns nodes (n, 3) [m] and tetrahedra (m, 4) of what is inside of a shape.

    low, high: corners of a box around it [m]; cell: edge of the lattice's cubes [m], 12 tetrahedra each
    """
    x, tets = lattice(np.asarray(low, float), np.asarray(high, float), cell)
    tets = _trimmed(tets[shape(x[tets].mean(axis=1)) < 0])
    for weight in WEIGHTS:
        x, tets = _compact(x, tets)
        x = _moved(shape, x, tets, cell, weight)
        tets = _cut(x, tets)
    x, tets = _compact(x, tets)
    return _moved(shape, x, tets, cell, WEIGHTS[-1]), tets


def skin(shape: Shape, low: Floats, high: Floats, cell: float, rounds: int = 30) -> tuple[Floats, Ints]:
    """Returns vertices (s, 3) [m] and triangles (t, 3) of the surface of a shape: that of a lattice, each vertex moved
    to the mean of its neighbours and back to the surface, again and again. Arguments as of `mesh`."""
    x, tets = lattice(np.asarray(low, float), np.asarray(high, float), cell)
    triangles = surface(_trimmed(tets[shape(x[tets].mean(axis=1)) < 0]))[0]
    used, number = np.unique(triangles, return_inverse=True)
    x, triangles = x[used], number.reshape(-1, 3)
    one, two = triangles.ravel(), triangles[:, [1, 2, 0]].ravel()
    degree = np.bincount(one, minlength=len(x))[:, None]
    for _ in range(rounds):
        mean = np.stack([np.bincount(one, x[two, k], len(x)) for k in range(3)], axis=1) / degree
        x = x + 0.6 * (mean - x)
        for _ in range(2):
            normal = _gradient(shape, x, 1e-4 * cell)
            square = np.maximum((normal**2).sum(axis=1), 0.1)
            x = x - (shape(x) / square)[:, None] * normal
    return x, triangles


def lattice(low: Floats, high: Floats, cell: float) -> tuple[Floats, Ints]:
    """Returns the body-centred cubic lattice over a box; x = 0 is a plane of symmetry of it."""
    first, last = np.floor(low / cell).astype(int) - 1, np.ceil(high / cell).astype(int) + 1
    counts = last - first
    corner_number = np.arange(np.prod(counts + 1)).reshape(counts + 1)
    centre_number = corner_number.size + np.arange(np.prod(counts)).reshape(counts)
    corners = np.stack(np.meshgrid(*(np.arange(n + 1) for n in counts), indexing="ij"), axis=-1)
    centres = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in counts), indexing="ij"), axis=-1)
    x = (np.concatenate([corners.reshape(-1, 3), centres.reshape(-1, 3)]) + first) * cell
    found = []
    for axis in range(3):
        one, two = (np.delete(centre_number, end, axis).ravel() for end in (-1, 0))
        inside = corner_number.take(range(1, counts[axis]), axis)
        others = [a for a in range(3) if a != axis]
        ring = []
        for shift in ((0, 0), (1, 0), (1, 1), (0, 1)):
            of = inside
            for other, s in zip(others, shift, strict=True):
                of = of.take(range(s, counts[other] + s), other)
            ring.append(of.ravel())
        found += [np.stack([one, two, a, b], axis=1) for a, b in pairwise([*ring, ring[0]])]
    tets = np.concatenate(found)
    turned = volumes(x, tets) < 0
    tets[turned] = tets[turned][:, [0, 1, 3, 2]]
    return x, tets


def volumes(x: Floats, tets: Ints) -> Floats:
    """Returns the signed volumes (m,) [m3]."""
    a, b, c = (x[tets[:, k]] - x[tets[:, 0]] for k in (1, 2, 3))
    return np.einsum("ij,ij->i", np.cross(a, b), c) / 6


def dihedral_angles(x: Floats, tets: Ints) -> Floats:
    """Returns the angles (m, 4, 4) [degrees] between the faces against each two corners; NaN on the diagonal."""
    p = x[tets[:, FACES]]
    normal = np.cross(p[:, :, 1] - p[:, :, 0], p[:, :, 2] - p[:, :, 0])
    normal /= np.linalg.norm(normal, axis=2, keepdims=True)
    cosine = -np.einsum("eik,ejk->eij", normal, normal)
    cosine[:, range(4), range(4)] = np.nan
    return np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def surface(tets: Ints) -> tuple[Ints, Ints]:
    """Returns the triangles (t, 3) at the surface, normals outward, and the element and corner of each, (t, 2)."""
    faces = tets[:, FACES].reshape(-1, 3)
    _, where, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    alone = np.sort(where[count == 1])
    return faces[alone], np.stack([alone // 4, alone % 4], axis=1)


def _trimmed(tets: Ints) -> Ints:
    """Leaves out elements that hang on by one face or less, those at edges where the surface touches itself, and all
    but the largest connected part."""
    while True:
        triangles, own = surface(tets)
        edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        _, number, count = np.unique(edges, axis=0, return_inverse=True, return_counts=True)
        left_out = np.bincount(own[:, 0], minlength=len(tets)) > 2
        left_out[np.repeat(own[:, 0], 3)[count[number] > 2]] = True
        if not left_out.any():
            return _largest_part(tets)
        tets = tets[~left_out]


def _largest_part(tets: Ints) -> Ints:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    faces = np.sort(tets[:, FACES].reshape(-1, 3), axis=1)
    order = np.lexsort(faces.T)
    same = np.flatnonzero((faces[order[1:]] == faces[order[:-1]]).all(axis=1))
    one, two = order[same] // 4, order[same + 1] // 4
    _, part = connected_components(coo_array((np.ones(len(one)), (one, two)), (len(tets), len(tets))), directed=False)
    return tets[part == np.bincount(part).argmax()]


def _cut(x: Floats, tets: Ints) -> Ints:
    """Leaves out elements that two faces at the surface make flat, as long as the surface stays a surface."""
    triangles, own = surface(tets)
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    outer = {(int(a), int(b)) for a, b in edges}
    angle = dihedral_angles(x, tets)
    keep = np.ones(len(tets), bool)
    for e in np.flatnonzero(np.bincount(own[:, 0], minlength=len(tets)) == 2):
        one, two = own[own[:, 0] == e, 1]
        behind = (min(tets[e, one], tets[e, two]), max(tets[e, one], tets[e, two]))  # becomes an edge of the surface
        if angle[e, one, two] > FLAT and behind not in outer:
            keep[e] = False
            outer.add(behind)
    return _trimmed(tets[keep])


def _compact(x: Floats, tets: Ints) -> tuple[Floats, Ints]:
    """Numbers the nodes in use from 0, along the longest axis of the box around them, which keeps matrices narrow."""
    used = np.unique(tets)
    axis = np.ptp(x[used], axis=0).argmax()
    used = used[np.argsort(x[used, axis], kind="stable")]
    number = np.zeros(len(x), np.int64)
    number[used] = np.arange(len(used))
    return x[used], number[tets]


def _moved(shape: Shape, x: Floats, tets: Ints, cell: float, weight: float) -> Floats:
    """Returns the positions of least distortion and distance.

    weight: of squared distances [cell^2] beside the distortion of an element
    """
    outer = np.unique(surface(tets)[0])

    def cost(x: Floats) -> tuple[float, Floats]:
        edges = np.stack([x[tets[:, k]] - x[tets[:, 0]] for k in (1, 2, 3)], axis=2)
        j = edges @ REGULAR
        det = np.linalg.det(j)
        if det.min() <= 0:
            return np.inf, x
        square = np.einsum("eij,eij->e", j, j)
        distortion = square / (3 * det ** (2 / 3))
        inverse = np.linalg.inv(j).transpose(0, 2, 1)
        slope = 2 * (j / square[:, None, None] - inverse / 3) * (POWER * distortion**POWER)[:, None, None]
        pull = slope @ REGULAR.T
        gradient = np.zeros_like(x)
        for k in range(3):
            np.add.at(gradient, tets[:, k + 1], pull[:, :, k])
            np.add.at(gradient, tets[:, 0], -pull[:, :, k])
        distance, normal = shape(x[outer]) / cell, _gradient(shape, x[outer], 1e-4 * cell)
        gradient[outer] += 2 * weight / cell * distance[:, None] * normal
        return float((distortion**POWER).sum() + weight * (distance**2).sum()), gradient * cell

    return _minimized(cost, x, cell)


def _gradient(shape: Shape, x: Floats, h: float) -> Floats:
    steps = h * np.eye(3)
    return np.stack([(shape(x + d) - shape(x - d)) / (2 * h) for d in steps], axis=1)


def _minimized(cost: Callable[[Floats], tuple[float, Floats]], x: Floats, unit: float, steps: int = 300) -> Floats:
    """L-BFGS with ten pairs and halved steps (Nocedal and Wright, algorithm 7.4), in positions over `unit`."""
    value, g = cost(x)
    pairs: list[tuple[Floats, Floats]] = []
    for _ in range(steps):
        q, factors = g.copy(), []
        for s, y in reversed(pairs):
            factors.append((s * q).sum() / (s * y).sum())
            q -= factors[-1] * y
        if pairs:
            s, y = pairs[-1]
            q *= (s * y).sum() / (y * y).sum()
        for (s, y), a in zip(pairs, reversed(factors), strict=True):
            q += (a - (y * q).sum() / (s * y).sum()) * s
        length = min(1.0, 0.3 / np.abs(q).max())
        slope = (g * q).sum()
        while True:
            new, after = cost(x - unit * length * q)
            if new <= value - 1e-4 * length * slope:
                break
            length /= 2
            if length < 1e-6:
                return x
        x, s, y = x - unit * length * q, -length * q, after - g
        if (s * y).sum() > 1e-12:
            pairs = [*pairs[-9:], (s, y)]
        done = value - new < 1e-7 * value
        value, g = new, after
        if done:
            break
    return x
