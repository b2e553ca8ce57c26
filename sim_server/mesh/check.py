# SPDX-License-Identifier: MIT
"""Checks of a tetrahedral mesh before anything is computed on it.

Each function returns None or one complaint that names the first few offenders and their count.
"""

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64
from sim_server.mesh.surface import EDGES, FACES, volumes

FLAT = 1e-12  # |volume| / (longest edge)^3 below which a tetrahedron is flat; rounding alone gives about 1e-15
COINCIDENT = 1e-9  # distance / diagonal of the bounding box below which two nodes are one
NAMED = 3  # offenders named in a message

Rest = Float64
Tets = NDArray[np.integer]


def complaints(rest: Rest, tets: Tets) -> Iterator[str]:
    """Yields what is wrong with the mesh, most basic first; each check runs only if the earlier ones found nothing."""
    for check in (shapes, coordinates, indices, repeated_corners):
        if text := check(rest, tets):
            yield text
            return
    for check in (flat_tets, duplicate_tets, duplicate_nodes, unused_nodes):
        if text := check(rest, tets):
            yield text


def shapes(rest: Rest, tets: Tets) -> str | None:
    if rest.ndim != 2 or rest.shape[1] != 3:
        return f"node coordinates have shape {rest.shape}: must be (n, 3)"
    if tets.ndim != 2 or tets.shape[1] != 4 or not np.issubdtype(tets.dtype, np.integer):
        return f"tetrahedra have shape {tets.shape} and type {tets.dtype}: must be whole numbers (m, 4)"
    return None if len(tets) else "no tetrahedra"


def coordinates(rest: Rest, tets: Tets) -> str | None:
    bad = np.flatnonzero(~np.isfinite(rest).all(axis=1))
    return named("node", bad, "coordinates are not finite", lambda i: _point(rest[i]))


def indices(rest: Rest, tets: Tets) -> str | None:
    bad = np.flatnonzero(((tets < 0) | (tets >= len(rest))).any(axis=1))
    return named("tet", bad, f"node numbers must be 0 to {len(rest) - 1}", lambda i: f"nodes {tets[i].tolist()}")


def repeated_corners(rest: Rest, tets: Tets) -> str | None:
    bad = np.flatnonzero((np.diff(np.sort(tets, axis=1), axis=1) == 0).any(axis=1))
    return named("tet", bad, "a node occurs twice in it", lambda i: f"nodes {tets[i].tolist()}")


def flat_tets(rest: Rest, tets: Tets) -> str | None:
    volume = np.abs(volumes(rest, tets))
    longest = np.max([np.linalg.norm(rest[tets[:, a]] - rest[tets[:, b]], axis=1) for a, b in EDGES], axis=0)
    bad = np.flatnonzero(~(volume > FLAT * longest**3))  # so written, NaN is flat too
    return named("tet", bad, "zero volume", lambda i: f"{volume[i]:.3g} m3 at a longest edge of {longest[i]:.3g} m")


def duplicate_tets(rest: Rest, tets: Tets) -> str | None:
    corners = np.sort(tets, axis=1)
    order = np.lexsort(corners.T)
    same = (np.diff(corners[order], axis=0) == 0).all(axis=1)
    bad = order[1:][same]
    return named("tet", np.sort(bad), "the same four nodes as an earlier tet", lambda i: f"nodes {tets[i].tolist()}")


def duplicate_nodes(rest: Rest, tets: Tets) -> str | None:
    from scipy.spatial import cKDTree

    if len(rest) < 2:
        return None
    distance, neighbour = (np.asarray(found) for found in cKDTree(rest).query(rest, k=2))
    bad = np.flatnonzero(distance[:, 1] <= COINCIDENT * np.linalg.norm(np.ptp(rest, axis=0)))

    def other(i: int) -> str:
        a, b = neighbour[i].tolist()
        return f"with node {a if b == i else b} at {_point(rest[i])}"

    return named("node", bad, "coincides with another node", other)


def unused_nodes(rest: Rest, tets: Tets) -> str | None:
    bad = np.flatnonzero(np.bincount(tets.ravel(), minlength=len(rest)) == 0)
    reason = "belongs to no tetrahedron (meshio: mesh.remove_orphaned_nodes())"
    return named("node", bad, reason, lambda i: f"at {_point(rest[i])}")


def crowded_faces(rest: Rest, tets: Tets) -> str | None:
    """Describes faces of more than two tetrahedra, where parts of the mesh overlap; only logged."""
    faces = np.sort(tets[:, FACES].reshape(-1, 3), axis=1)
    faces = faces[np.lexsort(faces.T)]
    bad = np.flatnonzero((faces[2:] == faces[:-2]).all(axis=1))
    if not bad.size:
        return None
    return f"{bad.size} faces belong to more than two tets, as that of nodes {faces[bad[0]].tolist()}"


def _point(x: Float64) -> str:
    return "(" + ", ".join(f"{c:.6g}" for c in x) + ")"


def named(what: str, bad: NDArray[np.integer], why: str, detail: Callable[[int], str]) -> str | None:
    """Returns a complaint about the first of the items `bad`, None without any."""
    if not bad.size:
        return None
    first = ", ".join(f"{what} {i} ({detail(i)})" for i in bad[:NAMED].tolist())
    more = f", ... {bad.size} in all" if bad.size > NAMED else ""
    return f"{first}{more}: {why}"
