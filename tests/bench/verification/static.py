# SPDX-License-Identifier: MIT
"""`bench verification`: beams, Cook's membrane and a made-up solution, with their convergence on finer meshes."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from sim_server.mesh import bar as bar_mesh
from tests.bench.verification.loads import push, raised, settle, statics
from tests.bench.verification.row import Row, absolute, relative
from tests.physics.test_cantilever import AREA, DENSITY, INERTIA, LENGTH, YOUNG, cantilever, lowest_mode

Reals = NDArray[np.float64]
Curves = dict[str, tuple[list[int], list[float]]]  # label -> cells over the height, relative error
SLENDER = 20.0  # length over height
BEAM = {"st_venant_kirchhoff": {"young": 1e6, "poisson": 0.0}}
TIP, WEIGHT = {1.0: 2, 10.0: 8}, {1.0: 1, 10.0: 1}  # load: parts that it comes in
ELASTICA = "inextensible elastica (Euler), shooting to 1e-10 when this page is made"


def limit(values: list[float]) -> float:
    """Of a second-order method, from the last two meshes, the second twice as fine."""
    return (4 * values[-1] - values[-2]) / 3


def elastica(load: float, weight: bool) -> tuple[float, float]:
    """At the tip, w / L and u / L: theta'' = -load cos theta, by 1 - s for its weight; theta(0) = theta'(1) = 0."""

    def shot(bend: float) -> Reals:
        def rate(s: float, y: Reals) -> list[float]:
            return [y[1], -load * (1 - s if weight else 1.0) * np.cos(y[0]), np.sin(y[0]), np.cos(y[0])]

        return np.asarray(solve_ivp(rate, (0, 1), [0, bend, 0, 0], rtol=1e-11, atol=1e-12).y[:, -1])

    end = shot(float(brentq(lambda bend: shot(bend)[1], 0, load, xtol=1e-12)))
    return float(end[2]), float(1 - end[3])


def bent(load: float, parts: int, cells: int, weight: bool) -> Reals:
    """w / L and u / L at the tip of a cantilever: P L^2 / EI = load at the tip, or q L^3 / EI = load along it."""
    width, young = 1.5, 1e6
    mesh = bar_mesh((int(SLENDER) * cells, cells, 2), (SLENDER, 1.0, width), "kuhn")
    stiffness = young * width / 12  # E I, height 1
    gravity = (0.0, -load * stiffness / SLENDER**3 / (1000 * width), 0.0) if weight else None
    sim = statics(mesh.rest, mesh.tets, BEAM, "X < 1e-6", gravity)
    tip = np.flatnonzero(mesh.rest[:, 0] > SLENDER - 1e-6)
    force = [0.0, -load * stiffness / SLENDER**2, 0.0]
    u = settle(sim) if weight else raised(sim, [(tip, force)], parts)
    return -u[tip][:, [1, 0]].mean(axis=0) / SLENDER


def beams(meshes: list[int]) -> tuple[list[Row], Curves]:
    rows, curves = [], Curves()
    for what, table, weight in (("tip load P L²/EI", TIP, False), ("own weight q L³/EI", WEIGHT, True)):
        for load, parts in table.items():
            down, back = elastica(load, weight)
            found = np.array([bent(load, parts, n, weight) for n in meshes])
            name = f"cantilever, {what} = {load:g}"
            curves[name] = meshes, [float(abs(w / down - 1)) for w in found[:, 0]]
            most = 0.01 if len(meshes) > 2 else 0.4
            rows.append(relative(f"{name}: w/L, limit of the meshes", down, limit(list(found[:, 0])), most, ELASTICA))
            rows.append(absolute(f"{name}: u/L, limit", back, limit(list(found[:, 1])), most, ELASTICA))
            note = f"{name}: w/L, {meshes[-1]} cells over the height (locking)"
            rows.append(relative(note, down, found[-1, 0], 0.2 if len(meshes) > 2 else 0.5, ELASTICA))
    return rows, curves


def cook(cells: int) -> float:
    """Deflection of (48, 52) in Cook's membrane: (0, 0), (48, 44), (48, 60), (0, 44), sheared at the right by 1."""
    thickness = 48 / cells
    mesh = bar_mesh((cells, cells, 1), (1.0, 1.0, 1.0), "kuhn")
    X, Y, Z = mesh.rest.T
    rest = np.column_stack([48 * X, 44 * X + Y * (44 - 28 * X), thickness * Z])
    small = 1e-6 * thickness
    sim = statics(rest, mesh.tets, {"corotational": {"young": 1.0, "poisson": 1 / 3}}, "X < 1e-6")
    right = X > 1 - 1e-9
    inner = right & (Y > 1e-9) & (Y < 1 - 1e-9)
    per = small / cells / 2  # of the edge's force for a node at its end, on either face
    ends = np.flatnonzero(right & ~inner)
    push(sim, [(np.flatnonzero(inner), [0, 4 * per * (cells - 1) / 2, 0]), (ends, [0, 2 * per, 0])])
    u = settle(sim)
    return float(u[right & (np.abs(Y - 0.5) < 1e-9), 1].mean() / 1e-6)


def membrane(meshes: list[int]) -> tuple[list[Row], Curves]:
    found = [cook(n) for n in meshes]
    source = "Cook 1974; the value in use for plane stress at (48, 52), which 256 x 256 bilinear quadrilaterals confirm"
    most = 0.02 if meshes[-1] > 16 else 0.1
    rows = [
        relative("Cook's membrane, E = 1, ν = 1/3: (48, 52), limit of the meshes", 23.96, limit(found), most, source)
    ]
    rows += [
        relative(f"Cook's membrane, {n} x {n} cells (locking)", 23.96, w, 0.9, source)
        for n, w in zip(meshes, found, strict=True)
    ]
    return rows, {"Cook's membrane": (meshes, [abs(w / 23.96 - 1) for w in found])}


def frequency(meshes: list[int]) -> tuple[list[Row], Curves]:
    exact = float(1.875104**2 * np.sqrt(YOUNG * INERTIA / (DENSITY * AREA * LENGTH**4)) / (2 * np.pi))
    found = [float(lowest_mode(cantilever(n))[0] / (2 * np.pi)) for n in meshes]
    a, b = meshes[-2:]
    ours = (b**2 * found[-1] - a**2 * found[-2]) / (b**2 - a**2)
    source = "Euler and Bernoulli: 0.55959 sqrt(E I / (rho A L⁴)), L/h = 16"
    rows = [
        relative("lowest frequency of a cantilever [Hz], limit of the meshes", exact, ours, 0.02, source),
        relative(f"lowest frequency [Hz], {b} cells over the height (locking)", exact, found[-1], 0.5, source),
    ]
    return rows, {"frequency": (meshes, [abs(f / exact - 1) for f in found])}


# --- a made-up solution ---------------------------------------------------------------------------------------------

SIZE, DIRECTION = 0.06, np.array([1.0, -0.5, 0.7])
LAMBDA, MU = 0.3 / (1.3 * 0.4), 1 / 2.6  # E = 1, nu = 0.3


def field(X: Reals) -> Reals:
    """u (n, 3): zero on the surface of the unit cube."""
    return SIZE * np.sin(np.pi * X).prod(axis=1)[:, None] * DIRECTION


def slope(X: Reals) -> Reals:
    """du/dX (n, 3, 3)."""
    s, c = np.sin(np.pi * X), np.pi * np.cos(np.pi * X)
    g = np.stack([c[:, 0] * s[:, 1] * s[:, 2], s[:, 0] * c[:, 1] * s[:, 2], s[:, 0] * s[:, 1] * c[:, 2]], axis=1)
    return np.asarray(SIZE * DIRECTION[None, :, None] * g[:, None, :])


def venant(F: Reals) -> Reals:
    E = (np.swapaxes(F, 1, 2) @ F - np.eye(3)) / 2
    return np.asarray(F @ (LAMBDA * np.trace(E, axis1=1, axis2=2)[:, None, None] * np.eye(3) + 2 * MU * E))


def neo(F: Reals) -> Reals:
    inverse = np.swapaxes(np.linalg.inv(F), 1, 2)
    return np.asarray(MU * (F - inverse) + LAMBDA * np.log(np.linalg.det(F))[:, None, None] * inverse)


def load(P: Callable[[Reals], Reals], X: Reals, step: float = 1e-3) -> Reals:
    """-Div P (n, 3) by central differences of fourth order: errors of 1e-10."""
    out = np.zeros_like(X)
    for j in range(3):
        at = [P(np.eye(3) + slope(X + k * step * np.eye(3)[j]))[:, :, j] for k in (-2, -1, 1, 2)]
        out -= (at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * step)
    return out


def error_of(law: str, P: Callable[[Reals], Reals], cells: int) -> tuple[float, float]:
    """In L2 and in the H1 seminorm, relative."""
    mesh = bar_mesh((cells,) * 3, (1.0, 1.0, 1.0), "kuhn")
    hold = " or ".join(f"{a} < 1e-6 or {a} > 0.999999" for a in "XYZ")
    sim = statics(mesh.rest, mesh.tets, {law: {"young": 1.0, "poisson": 0.3}}, hold, slender=False)
    corners = mesh.rest[mesh.tets]
    edges = corners[:, 1:] - corners[:, :1]
    volume = np.linalg.det(edges) / 6
    share = np.bincount(mesh.tets.ravel(), np.repeat(volume / 4, 4))
    inside = np.flatnonzero(sim.world.free > 0)
    b = load(P, mesh.rest) * share[:, None]
    u = raised(sim, [(np.array([i]), list(b[i])) for i in inside], 3)
    point, other = (5 + 3 * np.sqrt(5)) / 20, (5 - np.sqrt(5)) / 20  # of second degree
    weights = other + (point - other) * np.eye(4)
    du = u[mesh.tets]
    G = np.swapaxes(np.linalg.solve(edges, du[:, 1:] - du[:, :1]), 1, 2)
    norms = np.zeros((2, 2))
    for w in weights:
        X = np.einsum("a,mai->mi", w, corners)
        exact, gradient = field(X), slope(X)
        norms[0] += [volume @ ((np.einsum("a,mai->mi", w, du) - exact) ** 2).sum(1), volume @ (exact**2).sum(1)]
        norms[1] += [volume @ ((G - gradient) ** 2).sum((1, 2)), volume @ (gradient**2).sum((1, 2))]
    l2, h1 = np.sqrt(norms[:, 0] / norms[:, 1])
    return float(l2), float(h1)


def made_up(meshes: list[int]) -> tuple[list[Row], Curves]:
    """Orders in space at strains of a quarter; StVK bears no load at much larger ones."""
    rows, curves = [], Curves()
    for law, P in (("st_venant_kirchhoff", venant), ("neo_hookean", neo)):
        found = np.array([error_of(law, P, n) for n in meshes])
        order = [np.log(b / a) / np.log(m / n) for (m, a), (n, b) in pairwise(zip(meshes, found, strict=True))][-1]
        source = "P1 elements: Strang and Fix 1973; body force of u = 0.06 d sin πX sin πY sin πZ"
        most = 0.1 if len(meshes) > 2 else 0.6
        rows.append(absolute(f"{law}: order in space, L2", 2, order[0], most, source))
        rows.append(absolute(f"{law}: order in space, H1", 1, order[1], most, source))
        curves |= {f"{law}, {n}": (meshes, found[:, k].tolist()) for k, n in enumerate(("L2", "H1"))}
    return rows, curves
