# SPDX-License-Identifier: MIT
"""Parameters that change while steps run."""

from itertools import chain

import numpy as np
import pytest

from sim_server.effects import effect, known_effects
from sim_server.parameters import BadParameter
from sim_server.scene.live import Live, live_fields
from sim_server.scene.model import Scene
from sim_server.scene.overrides import region_of
from sim_server.simulation import Simulation
from tests.parameters.cases import CASES, both, same, table
from tests.scenes import bar, simulation


@pytest.mark.parametrize("name", CASES)
def test_what_is_set_is_as_if_it_had_been_in_the_scene(name):
    """To the bit; all arrays of all launches are the same, too, where nothing came before."""
    case = CASES[name]
    one, other = both(case)
    assert same(one, other)
    assert not same(other, unchanged(case)), "the values matter"
    if case.start:
        for a, b in zip(one.engine.launches, other.engine.launches, strict=True):
            assert a.name == b.name
            for key, array in a.arrays.items():
                if key in ("changed_at", "copied_at"):  # when nodes lost elements, or were copied
                    continue
                assert np.array_equal(array, b.arrays[key], equal_nan=True), (a.name, key)


def unchanged(case):
    sim = Simulation(Scene.model_validate(table(case)))
    sim.engine.run(6 if case.start else 11)
    return sim


def test_every_live_parameter_has_a_case():
    fields = chain.from_iterable(live_fields(Scene.model_validate(table(case))) for case in CASES.values())
    short = {f.short: f for f in fields}
    keys = {key for case in CASES.values() for key in case.values if not region_of(key)[1]}
    tried = {(short[key].of, key.rpartition(".")[2]) for key in keys}
    marked = {
        (name, key)
        for name in known_effects()
        for key, field in effect(name).Params.model_fields.items()
        if any(isinstance(m, Live) for m in field.metadata)
    }
    assert marked | {("friction", "friction")} <= tried


def test_what_waits_is_set_together_with_what_comes_next():
    """In a pause a command may follow a command; the loop takes them up together, the newest values of each."""
    case, given = CASES["rayleigh"], []
    one, other = both(case)
    sim = Simulation(Scene.model_validate(table(case)))
    sim.parameters.on_set.append(given.append)
    sim.engine.run(5)
    sim.parameters.set({"bar.rayleigh.mass": "7"}, "a")
    sim.parameters.set({"bar.rayleigh.stiffness": "0.02"})
    sim.parameters.set({"object.bar.effects.rayleigh.mass": " 3.0 "}, "b")
    sim.engine.run(6)
    assert same(sim, one) and same(sim, other)
    assert [u.taken for u in given] == [-1, -1, 5] and given[2].client == "b" and given[2].replaces is given[1]
    key = "object.bar.effects.rayleigh"
    assert given[2].values == {f"{key}.mass": "3.0", f"{key}.stiffness": "0.02"} == sim.parameters.changed
    assert sim.scene.objects[0].effects["rayleigh"].mass == 0.1, "the scene of the start stays what it is"
    sim.parameters.set({"bar.rayleigh.mass": "3.0"})
    assert len(given) == 3, "nothing changes"


def test_what_is_set_and_set_back_before_the_loop_looks_never_was():
    """A replay knows what the loop took up alone; a step after a change is not like others in explicit schemes."""
    sims, given = [Simulation(Scene.model_validate(table(CASES["central_difference"]))) for _ in "xy"], []
    sims[0].parameters.on_set.append(given.append)
    for sim in sims:
        sim.engine.run(5)
    sims[0].parameters.set({"bar.corotational.young": "2e5"})
    sims[0].parameters.set({"bar.corotational.young": "1e5"})
    assert given[1].values == {} and given[1].replaces is given[0] and not sims[0].engine.withdraw_changes()
    assert sims[0].parameters.known_to_workers
    for sim in sims:
        sim.engine.run(5)
    assert same(*sims)
    sims[0].parameters.set({"bar.corotational.young": "2e5", "gravity.g": "[0, 0, 0]"})
    sims[0].parameters.set({"bar.corotational.young": "1e5"})
    sims[1].parameters.set({"gravity.g": "[0, 0, 0]"})
    assert given[3].values == {"effects.gravity.g": "[0.0, 0.0, 0.0]"}
    for sim in sims:
        sim.engine.run(5)
    assert same(*sims)


REFUSED = {
    "dt": ("0.02", "cannot change while steps run, since the time step is an argument of every kernel"),
    "bar.density": ("900", "cannot change while steps run, since masses are taken when the simulation is built"),
    "bar.mesh.bar": ("[1, 1, 1]", "cannot change while steps run, since all arrays are of the size of the mesh"),
    "integrator.scheme": ("'bdf2'", "cannot change while steps run, since the kernels of a step are chosen by it"),
    "solver.tolerance": ("1e-3", "cannot change while steps run, since solver, factors and workers are set up"),
    "object.bar.effects.corotational.tangent": ("'exact'", "cannot change while steps run"),
    "bar.corotational.young": ("-1", "young = -1: must be greater than 0"),
    "bar.corotational.poisson": ("0.5", "poisson = 0.5: must be less than 0.5"),
    "gravity.g": ("[0, inf, 0]", "must be a finite number"),
    "bar.rayleigh.mass": ("0.1", "cannot change to this value, since the scene began with 0 at all objects"),
    "bar.colour": ("1", "no parameter 'bar.colour'"),
    "bar.fixed.where": ("'X < 1'", "cannot change while steps run"),
    "other.corotational.young": ("1e5", "is a list of 2 regions in the scene"),
    "other.corotational.poisson": ("[0.2]", "must be a number"),
    "other.corotational.poisson[tumour]": ("0.5", "poisson = 0.5: must be less than 0.5"),
    "other.corotational.poisson[tumor]": ("0.4", "poisson has no region 'tumor'; did you mean 'tumour'?"),
    "other.corotational.colour[tumour]": ("0.4", "colour = 0.4: unknown key"),
    "bar.corotational.poisson[tumour]": ("0.4", "poisson has no region 'tumour'"),
}


@pytest.fixture(scope="module")
def two_bars():
    regions = [{"where": "X < 1", "young": 1e5, "name": "tumour"}, {"young": 2e5}]
    damped = bar((2, 1, 1), fixed="X < 0.01", damping=(0.0, 0.01))
    return simulation(damped, bar((2, 1, 1), name="other", young=regions), gravity=(0, -9.81, 0))


@pytest.mark.parametrize("key", REFUSED)
def test_what_cannot_change_is_refused_with_the_reason(two_bars, key):
    """And with it all of its command."""
    value, reason = REFUSED[key]
    with pytest.raises(BadParameter) as refused:
        two_bars.parameters.set({"bar.rayleigh.stiffness": "0.02", key: value})
    assert reason in str(refused.value), refused.value
    assert two_bars.parameters.changed == {} and not two_bars.engine.withdraw_changes()


def test_damping_of_the_stiffness_is_refused_where_stages_have_no_kernel_for_it():
    """A law leaves it out if none of its bodies has any at the start, whatever others have."""
    law = {"neo_hookean": {"young": 1e5, "poisson": 0.3}}
    plain = bar((2, 1, 1), young=None, effects=law | {"rayleigh": {"mass": 0.1}})
    sim = simulation(plain, bar((2, 1, 1), name="other", damping=(0.0, 0.01)), integrator={"scheme": "ros2"})
    with pytest.raises(BadParameter, match="the object began with 0"):
        sim.parameters.set({"bar.rayleigh.stiffness": "0.05"})
    sim.parameters.set({"other.rayleigh.stiffness": "0.05"})


def test_regions_are_refused_where_an_element_is_in_none(two_bars):
    with pytest.raises(BadParameter, match="is in no region of young"):
        two_bars.parameters.set({"other.corotational.young": '[{ where = "X < 1", young = 1e5 }]'})


def test_a_constant_of_a_region_is_set_by_its_name():
    """Others of the same list in the same command, too; the log is told of the whole list."""
    regions = [{"where": "X < 1", "young": 1e5, "name": "tumour"}, {"young": 2e5, "poisson": 0.1}]
    sim, given = simulation(bar((2, 1, 1), young=regions)), []
    sim.parameters.on_set.append(given.append)
    sim.parameters.set({"bar.corotational.poisson[tumour]": "0.45", "bar.corotational.young[tumour]": "3e5"})
    sim.engine.run(1)
    young, poisson = sim.effects["corotational"].elastic[0]
    here = sim.world.bodies[0].centroids[:, 0] < 1
    assert (young == np.where(here, 3e5, 2e5)).all() and (poisson == np.where(here, 0.45, 0.1)).all()
    assert list(given[0].values) == ["object.bar.effects.corotational.young"] and given[0].taken == 0
    whole = given[0].values["object.bar.effects.corotational.young"]
    for twice in ({"young": whole, "poisson[tumour]": "0.2"}, {"poisson[tumour]": "0.2", "young": whole}):
        with pytest.raises(BadParameter, match="is set twice"):
            sim.parameters.set({f"bar.corotational.{key}": value for key, value in twice.items()})


def test_parameters_are_listed_with_units_bounds_and_meaning(two_bars):
    found = {p.field.short: p for p in two_bars.parameters}
    assert list(found) == ["gravity.g", *(f"{name}.{key}" for name, keys in (
        ("bar", ("corotational.young", "corotational.poisson", "rayleigh.mass", "rayleigh.stiffness")),
        ("other", ("corotational.young", "corotational.poisson"))) for key in keys)]  # fmt: skip
    young = found["bar.corotational.young"]
    assert (young.text, young.field.unit, young.low, young.high) == ("100000.0", "Pa", 1e3, 1e7)
    assert young.field.live.logarithmic and young.field.about.startswith("Young's modulus")
    regions = found["other.corotational.young"]
    assert regions.low == regions.high == 0 and '"where" = "X < 1"' in regions.text
    two_bars.parameters.set({"other.corotational.young": regions.text})  # the same
    assert two_bars.parameters.changed == {}


def test_a_change_of_stiffness_is_work_and_no_runaway():
    """Of as much as it adds to the elastic energy. The balance of a body that is a thousand times as stiff holds."""
    sim = simulation(bar((4, 1, 1), fixed="X < 0.01"), gravity=(0, -9.81, 0), dt=0.01)
    sim.engine.run(20)
    before, elastic = sim.engine.records()[-1]["work"], sim.effects["corotational"].energy()
    sim.parameters.set({"bar.corotational.young": "1e8"})
    sim.engine.run(30)
    records = sim.engine.records()
    assert before == 0 and records["work"][0] == pytest.approx(999 * elastic, rel=1e-9)
    assert (records["kinetic"] <= records["budget"]).all() and (records["status"] == 0).all()
    sim.parameters.set({"bar.corotational.young": "1e5"})
    sim.engine.run(30)
    records = sim.engine.records()
    assert records["work"][-1] < 999 * elastic and (records["kinetic"] <= records["budget"]).all()


def test_workers_are_sent_matrices_once_a_parameter_was_set():
    """Those that assemble them know the scene as it was at the start."""
    sim = simulation(bar((2, 1, 1), fixed="X < 0.01"))
    sim.engine.run(2)
    assert sim.parameters.known_to_workers and sim.parameters.known_to_workers_at(2)
    sim.parameters.set({"bar.corotational.young": "2e5"})
    assert not sim.parameters.known_to_workers and sim.parameters.known_to_workers_at(2), "it waits"
    sim.parameters.set({"bar.corotational.young": "3e5"})
    sim.engine.run(2)
    sim.parameters.set({"bar.corotational.young": "4e5"})
    assert [sim.parameters.known_to_workers_at(step) for step in (1, 2, 3, 4)] == [True, False, False, False]


def test_viewers_are_told_of_the_new_modulus():
    sim = simulation(bar((2, 1, 1)))
    sim.parameters.set({"bar.corotational.young": "7e4", "bar.corotational.poisson": "0.1"})
    young, poisson = sim.effects["corotational"].elastic[0]
    assert (young == 7e4).all() and (poisson == 0.1).all()


@pytest.mark.parametrize("lasts", [False, True], ids=["once", "lasting"])
def test_an_error_that_no_check_foresees_leaves_scene_and_loop_alike(monkeypatch, lasts):
    sim, seen = simulation(bar(young=1e5, fixed="X < 0.01"), dt=0.02), []
    parameters, engine, change = sim.parameters, sim.engine, sim.engine.change
    sim.engine.run(1)
    parameters.on_set.append(seen.append)
    parameters.set({"bar.corotational.young": "3e5"})
    left = [10**9 if lasts else 1]

    def broken(changes):
        left[0] -= 1
        if left[0] >= 0:
            raise MemoryError("pinned")
        return change(changes)

    with monkeypatch.context() as patch:
        patch.setattr(engine, "change", broken)
        with pytest.raises(MemoryError):
            parameters.set({"bar.corotational.poisson": "0.1"})
    engine.run(1)
    young = 1e5 if lasts else 3e5
    assert {p.field.key.rpartition(".")[2]: p.field.value for p in parameters} == {"young": young, "poisson": 0.3}
    assert [not update.values for update in seen] == ([False, True] if lasts else [False])
    assert parameters.known_to_workers == lasts and (lasts or seen[0].taken == 1)
    for array in sim.world.live_arrays:
        assert np.array_equal(array.array, array.compute(parameters.scene))
    parameters.set({"bar.corotational.young": "2e5"})
    engine.run(1)
    for array in sim.world.live_arrays:
        assert np.array_equal(array.array, array.compute(parameters.scene))
