# SPDX-License-Identifier: MIT
"""Known answers of the hyperelastic laws: Hooke's law at small strains, the patch test, uniaxial tests, regions."""

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar

from sim_server.errors import InputError
from tests.physics.laws import ELASTIC, LAWS, axes_of, elements, forces, law_bar, odd_bar, stiffness
from tests.reference.corotational import stiffness as hooke
from tests.scenes import interior, jittered_bar, mesh_file, random_rotations

every_law = pytest.mark.parametrize("law", LAWS.values(), ids=LAWS.keys())
ISOTROPIC = {name: law for name, law in LAWS.items() if name not in ("costa", "fibres")}


@pytest.mark.parametrize("law", ISOTROPIC.values(), ids=ISOTROPIC.keys())
def test_at_small_strains_it_is_hookes_law(tmp_path, law):
    """The stiffness at rest, for the Young's modulus and Poisson's ratio that the effect tells viewers."""
    sim = odd_bar(tmp_path, law)
    young, poisson = elements(sim).elastic[0]
    expected = np.zeros((3 * sim.world.nodes,) * 2)
    for tet, E, nu in zip(sim.world.bodies[0].mesh.tets, young, poisson, strict=True):
        dofs = (3 * tet[:, None] + np.arange(3)).ravel()
        expected[np.ix_(dofs, dofs)] += hooke(sim.world.rest[tet], E, nu)
    assert np.abs(stiffness(sim) - expected).max() < 1e-9 * np.abs(expected).max()
    if "young" in law.table:
        assert set(young) == {ELASTIC["young"]} and set(poisson) == {ELASTIC["poisson"]}


AFFINE = np.array([[1.1, 0.05, 0.0], [0.0, 0.95, 0.08], [0.02, 0.0, 1.04]])
INVERTED = random_rotations(1, seed=5)[0] @ np.diag([1.0, 0.9, -0.5])


@every_law
def test_patch(tmp_path, law):
    """An affine displacement of a mesh of unequal elements leaves no force inside."""
    size = (1.2, 1.0, 0.8)
    sim = law_bar(law, mesh_file(tmp_path, *jittered_bar((3, 3, 3), size, seed=1)))
    inside = interior(sim.world.rest, size)
    for F in (AFFINE, INVERTED) if law.inverts else (AFFINE,):
        sim.world.x[:] = sim.world.rest @ F.T + [1.0, 2.0, 3.0]
        f = forces(sim)
        assert inside.sum() == 8 and np.abs(f[inside]).max() < 1e-12 * np.abs(f).max() + 1e-12 * 3e4
        assert np.abs(f[~inside]).max() > 1e-3 * 3e4


def cube(law: str, young: float, poisson: float):
    return law_bar(law, cells=(1, 1, 1), size=(1, 1, 1), table={"young": young, "poisson": poisson})


def pulled(sim, along: float, across: float) -> tuple[float, float]:
    """Stresses P11 and P22 of the unit cube stretched so: the forces on two of its faces."""
    sim.world.x[:] = sim.world.rest * [along, across, across]
    f, rest = forces(sim), sim.world.rest
    return -f[rest[:, 0] > 0.5, 0].sum(), -f[rest[:, 1] > 0.5, 1].sum()


UNIAXIAL = {  # E = 1, nu = 0.45: stretch -> lateral stretch, P11 (solved to 1e-12 apart from this program)
    0.5: (1.350870, -1.086103), 0.8: (1.104462, -0.249930), 1.2: (0.920634, 0.170239),
    1.5: (0.830679, 0.358614), 2.0: (0.725935, 0.598796), 3.0: (0.598315, 0.993336),
}  # fmt: skip


@pytest.mark.parametrize("along", UNIAXIAL)
def test_uniaxial_neo_hookean(along):
    sim = cube("neo_hookean", 1.0, 0.45)
    across = brentq(lambda s: pulled(sim, along, s)[1], 0.3, 2.0, xtol=1e-13)
    assert (across, pulled(sim, along, across)[0]) == pytest.approx(UNIAXIAL[along], abs=1e-6)


def test_st_venant_kirchhoff_bears_most_at_one_over_root_three():
    """Beyond it the stiffness along the bar is negative, and the projection lifts it to zero."""
    sim = cube("st_venant_kirchhoff", 1.0, 0.0)
    found = minimize_scalar(
        lambda s: pulled(sim, s, 1.0)[0], bounds=(0.2, 0.9), method="bounded", options={"xatol": 1e-8}
    )
    assert found.x == pytest.approx(1 / np.sqrt(3), abs=1e-4)
    assert found.fun == pytest.approx(-0.19245, abs=1e-5)
    for projection in ("none", "clamp"):
        sim = law_bar(
            "st_venant_kirchhoff", cells=(1, 1, 1), size=(1, 1, 1), table={"young": 1.0, "poisson": 0.0},
            projection=projection,
        )  # fmt: skip
        along = (sim.world.rest * [1, 0, 0]).ravel()
        slope = {}
        for stretch in (0.57, 0.5773, 0.5774, 0.58):
            pulled(sim, stretch, 1.0)
            slope[stretch] = along @ stiffness(sim) @ along
        if projection == "none":
            assert slope[0.57] < slope[0.5773] < 0 < slope[0.5774] < slope[0.58]
        else:
            assert min(slope.values()) > -1e-12


def test_constants_by_region():
    """The first constant as a list; what a region does not say is the object's."""
    regions = [{"where": "X < 1", "c1": 2e3, "bulk": 9e4}, {"c1": 7e3, "c2": 0.0}]
    sim = law_bar("mooney_rivlin", cells=(2, 1, 1), size=(2, 1, 1), table={"c1": regions, "c2": 1e3, "bulk": 5e4})
    effect = elements(sim)
    left = sim.world.rest[effect.elements].mean(axis=1)[:, 0] < 1
    assert left.sum() == 6
    assert np.unique(effect.constants[:, left], axis=1).T.tolist() == [[2e3, 1e3, 9e4]]
    assert np.unique(effect.constants[:, ~left], axis=1).T.tolist() == [[7e3, 0.0, 5e4]]


def test_directions_by_region():
    regions = [{"where": "X < 1", "stiffness": 1e4, "direction": [0, 0, 2]}, {"stiffness": 2e4}]
    table = {"stiffness": regions, "direction": [[3, 4, 0], [0, 1, 0]]}
    o = law_bar("neo_hookean", cells=(2, 1, 1), size=(2, 1, 1)).scene.objects[0]
    assert "fibres" not in o.effects
    law = LAWS["fibres"]
    sim = law_bar(law, cells=(2, 1, 1), size=(2, 1, 1), table=table)
    fibres = sim.effects["fibres"]
    left = sim.world.rest[fibres.elements].mean(axis=1)[:, 0] < 1
    assert np.unique(fibres.directions[:, left], axis=1).T.tolist() == [[0, 0, 1, 0, 0, 0]]
    assert np.unique(fibres.directions[:, ~left], axis=1).T.tolist() == [[0.6, 0.8, 0, 0, 1, 0]]
    assert set(fibres.constants[0, left]) == {1e4} and set(fibres.constants[0, ~left]) == {2e4}


def test_axes_of_costa_are_orthonormal():
    table = LAWS["costa"].table
    sim, plain = law_bar(LAWS["costa"], cells=(1, 1, 1)), law_bar("neo_hookean", cells=(1, 1, 1))
    turned, rows = (elements(s).gradients.T.reshape(-1, 3, 3) for s in (sim, plain))
    np.testing.assert_allclose(turned, rows @ axes_of(table["fibre"], table["sheet"]), atol=1e-12)


WRONG = {
    "no region": ("mooney_rivlin", {"c1": [{"where": "X < 0.1", "c1": 1.0}], "c2": 1.0, "bulk": 1.0}, InputError,
        r"object 'bar', effect mooney_rivlin: element \d+ with centroid .* is in no region of c1"),
    "unknown key in a region": ("mooney_rivlin", {"c1": [{"c1": 1.0, "c3": 1.0}], "c2": 1.0, "bulk": 1.0}, ValueError,
        r"mooney_rivlin.c1.*\n?.*c3"),
    "a negative modulus": ("neo_hookean", {"young": -1.0, "poisson": 0.3}, ValueError, r"neo_hookean.young"),
    "a word": ("neo_hookean", {"young": 1.0, "poisson": 0.3, "inversion": "maybe"}, ValueError,
        r"neo_hookean.inversion"),
    "no regularization": ("ogden", {"mu": [1.0], "alpha": [2.0], "bulk": 1.0, "inversion": "regularize"}, ValueError,
        r"unknown key"),
    "terms of the wrong sign": ("ogden", {"mu": [1.0], "alpha": [-2.0], "bulk": 1.0}, InputError, r"mu alpha > 0"),
    "more mu than alpha": ("ogden", {"mu": [1.0, 2.0], "alpha": [2.0], "bulk": 1.0}, InputError, r"as many"),
    "parallel axes": ("costa", {"a": 1.0, "bulk": 1.0, "fibre": [1, 0, 0], "sheet": [2, 0, 0]}, InputError,
        r"parallel"),
    "no direction": ("fibres", {"stiffness": 1.0, "direction": [0, 0, 0]}, ValueError, r"must not be zero"),
    "fibres alone": ("fibres", {"stiffness": 1.0, "direction": [1, 0, 0]}, InputError, r"list a material beside them"),
}  # fmt: skip


@pytest.mark.parametrize(("law", "table", "error", "message"), WRONG.values(), ids=WRONG.keys())
def test_what_a_law_refuses(law, table, error, message):
    with pytest.raises(error, match=message):
        law_bar(law, cells=(1, 1, 1), table=table)


@pytest.mark.parametrize("projection", ["positive", 1, True])
def test_projections_have_names(projection):
    with pytest.raises(ValueError, match=r"solver\.projection"):
        law_bar("neo_hookean", projection=projection)
