# SPDX-License-Identifier: MIT
"""Scenes are built for a GPU where there is none: texts compile with the options of a run, and launches fit kernels."""

import ctypes as c
from pathlib import Path

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from sim_server.backends import compiler
from sim_server.backends.gpu import device
from sim_server.backends.gpu.inverse import digits, partition
from sim_server.backends.gpu.inverse.build_inverse import InverseBuilder
from sim_server.backends.gpu.inverse.plan import plan
from sim_server.backends.gpu.islands import OWN_SURFACES
from sim_server.backends.gpu.newton import own_blocks
from sim_server.checkpoint.content import capture
from sim_server.explain.explanation import explain
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.state.arrays import state_arrays
from sim_server.state.code import build_id
from sim_server.state.start import Start
from sim_server.updates.driver import Driver
from tests.backends import fake_cupy
from tests.contact.scenes import block, floor, over, ram
from tests.cutting.cut_scenes import table as cut_table
from tests.cutting.split_scenes import SLIT, split
from tests.holders.holder_scenes import held_bar, left, right
from tests.own_effect.own_package import install, with_own_header
from tests.resets.going_on import resumed
from tests.resets.state_scenes import made
from tests.scenes import bar, scene
from tests.support import nvrtc
from tests.worker.block_matrices import bar_edges, pattern

pytestmark = pytest.mark.slow
SCENES = {
    "beam.toml": (),
    "beam.toml, mixed": ("solver.precision=mixed", "solver.factor_precision=float32"),
    "beam.toml, float32": ("solver.precision=float32",),
    "beam.toml, large, float32": (
        "object.beam.mesh={ bar = [10, 10, 40], size = [1, 1, 4] }",
        "solver.precision=float32",
    ),
    "beam.toml, Newton": ("integrator.linearizations=3", "integrator.scheme=newmark"),
    "beam.toml, accuracy": ("accuracy.position='1 %'", "solver.precision=mixed"),
    "graft.toml, accuracy": ("accuracy.position=1e-4", "solver.precision=mixed"),
    "beam.toml, budget of a search": ("solver.budget_ms=2", "integrator.linearizations=3", "solver.precision=mixed"),
    "four_beams.toml, budget of solves": ("solver.budget=1e-3",),
    "floor_drop.toml, accuracy": ("accuracy.position=1e-4",),
    "two_organs.toml, smoothed": ("object.tissue.elements=smoothed", "object.kidney.elements=smoothed"),
    "beam.toml, ros2": ("integrator.scheme=ros2", "solver.preconditioner=cholesky"),
    "beam.toml, ros2 in float32": (
        "integrator.scheme=ros2",
        "integrator.solve=iterate",
        "solver.precision=float32",
    ),
    "four_beams.toml, ros2": ("integrator.scheme=ros2", "solver.precision=mixed"),
    "needle_holder.toml, generalized alpha": (
        "integrator.scheme=generalized_alpha",
        "integrator.linearizations=2",
        "solver.precision=mixed",
    ),
    "beam.toml, patches": ("object.beam.elements=patch",),
    "beam.toml, smoothed in float32, exact tangent": (
        "object.beam.elements=smoothed",
        "solver.precision=float32",
        "integrator.scheme=newmark",
    ),
    "beam.toml, quadratic, mixed, ros2": (
        "object.beam.elements=quadratic",
        "solver.precision=mixed",
        "integrator.scheme=ros2",
    ),
    "beam.toml, smoothed, Newton": ("object.beam.elements=smoothed", "integrator.linearizations=3"),
    "fibres.toml, patches": ("object.beam.elements=patch", "integrator.linearizations=3"),
    "fibres.toml, patches in float32, ros2": (
        "object.beam.elements=patch",
        "solver.precision=float32",
        "integrator.scheme=ros2",
    ),
    "beam.toml, cut": ("object.beam.effects.cutting=true", "solver.precision=mixed"),
    "fibres.toml, cut in float32": ("object.beam.effects.cutting.removed='3-7'", "solver.precision=float32"),
    "beam.toml, split": ("object.beam.effects.cutting.spare=50", "object.beam.elements=linear"),
    "springs.toml, cut": ("object.block.effects.cutting=true", "integrator.scheme=bdf2"),
    "beam.toml, prony in float32": (
        "object.beam.effects.prony.terms=[{ g = 0.5, tau = 0.1 }, { g = 0.2, tau = 1 }]",
        "solver.precision=float32",
    ),
    "beam.toml, prony, mixed, Newton": (
        "object.beam.effects.prony.terms=[{ g = 0.5, tau = 0.1 }]",
        "solver.precision=mixed",
        "integrator.linearizations=3",
    ),
    "beam.toml, poroelasticity, mixed": (
        "object.beam.effects.poroelasticity.mobility=1e-9",
        "object.beam.effects.poroelasticity.storage=1e7",
        "solver.precision=mixed",
    ),
    "beam.toml, plasticity, mixed, Newton": (
        "object.beam.effects.plasticity.yield_stress=1e3",
        "solver.precision=mixed",
        "integrator.linearizations=3",
    ),
    "beam.toml, damage in float32, bdf2": (
        "object.beam.effects.damage={ strength = 1e4, fracture_energy = 1e5 }",
        "solver.precision=float32",
        "integrator.scheme=bdf2",
    ),
    "springs.toml": (),
    "fibres.toml": ("integrator.scheme=bdf2",),
    "equilibrium.toml": (),
}


@pytest.fixture(autouse=True)
def cupy(tmp_path, monkeypatch):
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    with fake_cupy.installed(tmp_path, library, monkeypatch) as fake:
        yield fake


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_is_built_and_its_kernels_compile(cupy, name):
    simulation = Simulation.load(f"deploy/scenes/{name.split(',')[0]}", list(SCENES[name]), "gpu")
    built = {kernel for kernel, _ in cupy.calls}
    assert {"fused", "pcg"} <= built and ("smoothed" in built) is ("large" in name)
    engine, world, system = simulation.engine, simulation.world, simulation.system
    engine.run(3)
    assert engine.step == 3 and (engine.records()["step"] == np.repeat([1, 2, 3], len(world.bodies))).all()
    engine.assemble()
    engine.solve()
    body = world.bodies[0]
    row_start, columns = system.body_pattern(body.first, body.last)
    rows, nodes = np.repeat(np.arange(body.last - body.first), np.diff(row_start)), body.last - body.first
    values = np.where((rows == columns)[:, None, None], 50 * np.eye(3), -0.5 * np.eye(3))
    analysis = Analysis(row_start, columns)
    engine.post_factor(body.index, analysis.pattern, analysis.factorize(values, np.float32), 4)
    engine.settle_factors()
    engine.run(1)
    assert engine.factor_bytes(body.index) > 9 * nodes


@pytest.mark.parametrize("tangent", ["usual", "exact"])
def test_launches_over_cells_and_patches_are_put_together_by_domain(cupy, tangent):
    """Cells, patches, elements, corners of patches, nodes, blocks: one kernel each, and the end of the step."""
    keys = ["object.beam.elements=smoothed", f"object.beam.effects.corotational.tangent={tangent}"]
    Simulation.load("deploy/scenes/beam.toml", keys, "gpu")
    names = [kernel for kernel, _ in cupy.calls]
    alone = {"measure", "means", "elements", "exact_elements", "gather", "gradients", "own_blocks", "blocks"}
    assert not (alone | {"gather_impulses", "gather_twists", "twist_blocks"}) & set(names)
    assert names[: names.index("pcg")].count("fused") >= 6


def test_memory_advances_once_a_step_between_the_energy_balance_and_the_elements(cupy):
    """A body that the balance freezes has no memory to advance."""
    keys = ["object.beam.effects.prony.terms=[{ g = 0.5, tau = 0.1 }]", "integrator.linearizations=3"]
    simulation = Simulation.load("deploy/scenes/beam.toml", keys, "gpu")
    cupy.calls.clear()
    simulation.engine.assemble()
    names = [kernel for kernel, _ in cupy.calls]
    assert names.count("advance") == 1
    assert names.index("energy_balance") < names.index("advance") < names.index("fused")
    cupy.calls.clear()
    simulation.engine.solve()
    assert "advance" not in [kernel for kernel, _ in cupy.calls]


def written_back(simulation):
    """Reads and writes all state of a simulation."""
    arrays = state_arrays(simulation)
    for array in arrays:
        array.write(array.read())
    assert len({array.name for array in arrays}) == len(arrays)


def test_a_scene_is_reset_saved_and_resumed(cupy):
    """State on the device is read and written; with contact and ties: below."""
    simulation = made("held", "gpu", preconditioner="block_jacobi")
    start = Start(simulation)
    names = [a.name for a in state_arrays(simulation)]
    assert len(set(names)) == len(names) and "engine.energies.balance" in names
    driver = Driver(simulation)
    driver.advance(3)
    start.reset("beam")
    start.reset()
    driver.advance(2)
    data = capture(simulation, driver, "test").to_bytes()
    driver.advance(2)
    again = resumed(data, simulation)  # the same one, since another takes as long to compile
    assert simulation.engine.step == 5
    assert again.advance(2)["step"].max() == simulation.engine.step == 7


@pytest.mark.parametrize(("name", "precision"), [("beam.toml", "float64"), ("springs.toml", "float32")])
def test_a_scene_with_explicit_substeps_is_built(cupy, name, precision):
    """A step has no solve, and four substeps between two decisions."""
    keys = ["integrator.scheme=central_difference", f"solver.precision={precision}"]
    engine = Simulation.load(f"deploy/scenes/{name}", keys, "gpu").engine
    names = [kernel for kernel, _ in cupy.calls]
    first = names.index("begin_substeps")
    last = names.index("end_round")
    assert "pcg" not in names and names[first:last].count("fused") >= 8 and "measure_frequency" in names[first:last]
    engine.run(3)
    assert engine.step == 3


@pytest.mark.parametrize(
    ("scheme", "precision"), [("backward_euler", "mixed"), ("ros2", "float64"), ("central_difference", "float32")]
)
def test_rollers_and_loads_on_surfaces_are_built(cupy, scheme, precision):
    """Their launches join the kernels over elements, nodes and blocks."""
    given = bar((2, 1, 1), fixed="X < 0.01")
    given["effects"]["fixed"] = [{"where": "X < 0.01"}, {"where": "Y < 0.01", "along": "y"}]
    given["effects"]["traction"] = {"where": "X > 1.99", "force": [1, 0, 0], "pressure": 2.0, "moment": [0, 1, 0]}
    sim = Simulation(scene(given, integrator={"scheme": scheme}, precision=precision), "gpu")
    sim.engine.run(3)
    assert sim.engine.step == 3
    names = "+".join(x.name for x in sim.step_launches)
    assert "traction.areas" in names and "traction.load" in names and "rollers.keep_force" in names
    assert ("roller_blocks.keep_blocks" in names) == (scheme != "central_difference")


@pytest.mark.parametrize("scheme", ["backward_euler", "central_difference"])
def test_parameters_are_copied_into_the_arrays_of_the_device(cupy, scheme):
    """And of the type that these have there; what makes work of the elastic energy compiles and is launched around."""
    given = bar((2, 1, 1), fixed="X < 0.01", damping=(0.1, 0.0))
    sim = Simulation(scene(given, integrator={"scheme": scheme}, precision="mixed"), "gpu")
    lame = sim.world.backend.known_twin(sim.effects["corotational"].lame)
    sim.engine.run(2)
    before = np.array(lame)
    sim.parameters.set({"bar.corotational.young": "1e6", "bar.rayleigh.mass": "3"})
    update = sim.parameters.set({"bar.corotational.young": "2e5"}) and sim.parameters.changed
    assert list(update.values()) == ["200000.0", "3.0"]
    assert np.array_equal(lame, before), "not before the next batch"
    sim.engine.run(1)
    assert lame.dtype == np.float32 and np.allclose(lame, 2 * before, rtol=1e-6)
    alpha = sim.integrator.alpha if scheme == "central_difference" else sim.effects["rayleigh"].alpha
    assert (sim.world.backend.known_twin(alpha) == 3).all()
    assert {"elastic_work"} <= {kernel for kernel, _ in cupy.calls}


@pytest.mark.parametrize(
    ("fixed", "solve", "precision"),
    [(None, "auto", "mixed"), (None, "iterate", "float32"), ("X < 0.01", "auto", "float64")],
)
def test_momenta_are_set_where_a_body_may_be_free(cupy, fixed, solve, precision):
    """By one more launch beside three of pcg; where all bodies are held neither launches nor texts know of it."""
    bars = [
        bar((2, 1, 1), name="held", fixed="X < 0.01"),
        bar((3, 2, 2), name="other", touch={"max_force": 9.0}, **({"fixed": fixed} if fixed else {})),
    ]
    stages = {"scheme": "ros2", "solve": solve}
    made = scene(*bars, dt=0.01, integrator=stages, preconditioner="cholesky", precision=precision)
    Simulation(made, "gpu")
    assert any("FreeBodies" in text for text, _ in cupy.compiled) == (fixed is None)
    launched = [kernel for kernel, _ in cupy.calls]
    assert 3 * launched.count("set_momenta") == (launched.count("pcg") if fixed is None else 0)
    assert ("apply_factor" in launched) == (solve == "auto")


@pytest.mark.parametrize("precision", ["float64", "mixed", "float32"])
def test_a_scene_with_contact_is_built(cupy, precision):
    solver = {"preconditioner": "cholesky", "precision": precision}
    simulation = over(floor(), floor(name="wall"), solver=solver, device="gpu")
    names = [kernel for kernel, _ in cupy.calls]
    one_pass = ["contact_forces", "pcg", "contact_search"]
    step = ["place", "detect", "begin_contact", *one_pass, *one_pass, "finish_contact", "fused"]
    first = names.index("place")
    assert names[first : first + len(step)] == step
    assert not any("face" in kernel for kernel in names) and not any("FACE_ROWS" in str(o) for _, o in cupy.compiled)
    assert ("pcg", 3) in cupy.calls, "with what a pass and the correction of the factor need"
    engine = simulation.engine
    engine.run(3)
    records, reactions = engine.records_and_reactions()
    assert records["step"].tolist() == [1, 2, 3] and reactions.shape == (3, 2, 6)
    written_back(simulation)
    exact = vars(simulation.contact.contact_input())
    twins = {name: engine.gpu.twin(array) for name, array in exact.items() if name in ("gap", "force", "normal")}
    assert {twin.dtype for twin in twins.values()} == {np.dtype("f8")}


@pytest.mark.parametrize(("count", "precision"), [(1, "float64"), (2, "mixed")])
def test_a_scene_whose_triangles_have_rows_is_built(cupy, precision, count):
    """Beside something that is no plane; of bodies that touch each other, too."""
    objects = [block(name=f"b{k}", at=(0, 0.07 * k, 0)) for k in range(count)]
    solver = {"preconditioner": "cholesky", "precision": precision}
    engine = over(ram(), floor(), objects=objects, solver=solver, device="gpu").engine
    names = [kernel for kernel, _ in cupy.calls]
    one_pass = ["face_forces", "contact_forces", "pcg", "face_search", "sweep_faces", "contact_search"]
    first = names.index("begin_contact")
    assert names[first + 1 : first + 13] == one_pass * 2 and names.count("detect_faces") == names.count("detect")
    assert names.index("detect") < names.index("detect_faces") < first
    assert names[names.index("finish_contact") - 1] == "finish_faces"
    assert ("sweep_island_faces" in names) == (count == 2)
    engine.run(2)
    engine.assemble()
    engine.solve()
    assert engine.records()["step"].tolist() == [step for step in (1, 2, 3) for _ in range(count)]


@pytest.mark.parametrize("precision", ["float64", "mixed", "float32"])
def test_a_scene_whose_bodies_touch_each_other_is_built(cupy, precision):
    """Detection is a part of the assembly; what belongs to islands is launched in such scenes alone."""
    solver = {"preconditioner": "cholesky", "precision": precision}
    objects = [block(name="low"), block(name="high", at=(0, 0.07, 0))]
    simulation = over(floor(), objects=objects, solver=solver, device="gpu")
    names = [kernel for kernel, _ in cupy.calls]
    first = names.index("place")
    before = ["place", "detect", "pair_boxes", "pair_trees", "pair_sites", "pair_edges", "look_at_bodies",
              "list_island_rows", "find_islands", "begin_contact"]  # fmt: skip
    assert names[first : first + len(before)] == before
    iteration = ["island_update", "island_factor", "island_multiply", "island_product", "coarse_solve", "island_finish"]
    at = names.index("island_factor") - 1
    assert names[at : at + len(iteration)] == iteration
    assert names.index("keep_pairs") < names.index("finish_contact") < names.index("know_pairs")
    assert not any(OWN_SURFACES in options for _, options in cupy.compiled)
    engine = simulation.engine
    engine.run(3)
    engine.assemble()
    engine.solve()
    assert engine.records()["step"].tolist() == [1, 1, 2, 2, 3, 3, 4, 4]
    written_back(simulation)


def test_a_scene_whose_body_touches_itself_is_built(cupy):
    """With the launches of bodies that touch each other, from texts of their own, also where triangles have rows."""
    table = ["obstacle.floor.shape=sphere", "obstacle.floor.radius=0.1"]
    engine = Simulation.load("deploy/scenes/ribbon.toml", table, "gpu").engine
    names = [kernel for kernel, _ in cupy.calls]
    first = names.index("pair_boxes")
    detection = ["pair_boxes", "pair_trees", "pair_sites", "pair_edges", "look_at_bodies"]
    assert names[first : first + len(detection)] == detection and "sweep_island_faces" in names
    assert sum(OWN_SURFACES in options for _, options in cupy.compiled) == 2
    engine.run(3)
    engine.assemble()
    engine.solve()
    records, reactions = engine.records_and_reactions()
    assert records["step"].tolist() == [1, 2, 3, 4] and reactions.shape == (4, 1, 6)


def test_bodies_that_are_told_not_to_touch_each_other_have_nothing_of_it(cupy):
    objects = [block(name="low"), block(name="high", at=(0, 0.07, 0))]
    over(floor(), objects=objects, contact={"between": False}, device="gpu")
    assert not any("pair" in kernel or "island" in kernel for kernel, _ in cupy.calls)


@pytest.mark.parametrize(
    ("law", "keys"),
    [
        ("corotational", {}),
        ("neo_hookean", {"solver": {"precision": "mixed"}, "integrator": {"scheme": "newmark", "linearizations": 3}}),
        ("corotational", {"solver": {"precision": "float32"}, "integrator": {"scheme": "generalized_alpha"}}),
        ("corotational", {"solver": {"preconditioner": "none"}, "integrator": {"scheme": "central_difference"}}),
    ],
    ids=["backward_euler", "newmark", "generalized_alpha", "central_difference"],
)
def test_a_body_that_is_split_has_the_arrays_of_one_that_began_so(cupy, law, keys):
    """At the addresses that it had; copies of nodes begin and splits are noted after the copies of a change."""

    def built(**own):
        given = cut_table(law, own={"cutting": {"spare": 60, **own}}, **keys)
        return Simulation(Scene.model_validate(given, context={"folder": "."}), "gpu")

    sim = built()
    sim.engine.run(2)
    gpu, pcg = sim.world.backend, sim.engine.solver.params.copy()
    followed = [a.array for a in sim.world.live_arrays if "cutting" in a.of]
    twins = [gpu.known_twin(array) for array in followed]
    before = [None if twin is None else twin.copy() for twin in twins]
    split(sim, SLIT)
    assert all(twin is None or np.array_equal(twin, old) for twin, old in zip(twins, before, strict=True))
    sim.engine.run(1)
    opened = sim.parameters.scene.objects[0].effects["cutting"].opened
    other = built(opened=opened)
    wanted = [other.world.backend.known_twin(a.array) for a in other.world.live_arrays if "cutting" in a.of]
    for twin, like in zip(twins, wanted, strict=True):
        assert (twin is None) == (like is None)
        assert twin is None or (twin.dtype == like.dtype and np.array_equal(twin, like))
    assert sum(twin is not None and not np.array_equal(twin, old) for twin, old in zip(twins, before, strict=True)) > 5
    pattern = sim.system.row_start, sim.system.columns
    lists = [*sim.engine.solver.follow(*pattern)]
    for array, contents in lists:
        assert array.dtype == contents.dtype and np.array_equal(array, contents)
    staged = sim.engine.stage([(each, each.copy()) for each in pattern])[0]
    copies = {(n, (c.c_char * n).from_address(target)[:]) for target, _, n in staged.copies}
    wanted = [sim.system.row_start, *(contents for _, contents in lists)]
    wanted += [own_blocks(*pattern)] if "linearizations" in str(keys) else []
    assert {(a.nbytes, a.tobytes()) for a in wanted} < copies and len(copies) == len(wanted) + 1, (
        "and the bodies' numbers"
    )
    assert np.array_equal(pcg, sim.engine.solver.params), "graphs keep their addresses"
    assert {"spawn", "note_splits"} <= {kernel for kernel, _ in cupy.calls}
    written_back(sim)


def test_steps_by_the_factor_alone_look_for_cuts_where_a_body_may_be_cut(cupy):
    own = {}
    for cuttable in (True, False):
        given = cut_table("corotational", integrator={"scheme": "ros2"}, solver={"preconditioner": "cholesky"})
        if not cuttable:
            del given["object"][0]["effects"]["cutting"]
        sim = Simulation(Scene.model_validate(given, context={"folder": "."}), "gpu")
        own[cuttable] = sim.engine.sequence.stages.solve_arguments(0)
        if cuttable:
            known = sim.world.backend.known_twin(sim.cutting.changed_at)
            assert own[True]["changed_at"] == known.data.ptr and known.dtype == np.float64
    assert own[False]["changed_at"] == 0 and own[True]["clock"] != 0


def test_a_scene_with_attachments_and_springs_alone_is_built(cupy):
    """They begin before islands are searched and end after all that moves nodes; nothing is detected."""
    simulation = Simulation.load("deploy/scenes/graft.toml", ["solver.precision=float32"], "gpu")
    engine = simulation.engine
    names = [kernel for kernel, _ in cupy.calls]
    first, last = names.index("begin_ties"), names.index("finish_contact")
    assert names[first : first + 4] == ["begin_ties", "look_at_bodies", "list_island_rows", "find_islands"]
    assert names[last : last + 3] == ["finish_contact", "know_pairs", "keep_ties"]
    assert not {"pair_boxes", "pair_trees", "pair_sites", "pair_sweep", "keep_pairs"} & set(names)
    assert names.index("keep_ties") < names.index("report_held")
    engine.run(3)
    engine.assemble()
    engine.solve()
    records, reactions = engine.records_and_reactions()
    assert records["step"].tolist() == [1, 1, 2, 2, 3, 3, 4, 4] and reactions.shape == (8, 3, 6)
    written_back(simulation)


def test_a_scene_without_contact_has_nothing_of_it(cupy):
    engine = Simulation.load("deploy/scenes/beam.toml", [], "gpu").engine
    assert not any("contact" in kernel for kernel, _ in cupy.calls)
    assert engine.records_and_reactions()[1].shape == (0, 0, 6)


def test_what_a_build_of_an_inverse_reads_is_there_before_its_own_stream_runs(cupy):
    """Also where its workspace is large enough already, so that nothing else waits."""
    gpu = device.Gpu()
    for cells in ((3, 2, 2), (2, 1, 1)):
        graph = pattern(int(np.prod(np.add(cells, 1))), bar_edges(*cells), np.arange(0))
        shape = Analysis(*graph).pattern
        cupy.zeros(1)
        assert cupy.pending
        builder = InverseBuilder(gpu, shape, plan(shape, 4))
        assert not cupy.pending
        builder.storage()
        assert not cupy.pending


@pytest.mark.parametrize("precision", ["float64", "mixed", "float32"])
def test_a_scene_with_holders_is_built(cupy, precision):
    """Their launches come after the energy balance, which reads velocities, and around the solve; once a step."""
    keys = [{"time": 1.0, "translate": [0.1, 0, 0]}]
    solver = {"preconditioner": "cholesky", "precision": precision}
    engine = held_bar(left(), right(keyframes=keys), solver=solver, device="gpu").engine
    names = [kernel for kernel, _ in cupy.calls]
    first = names.index("place")
    assert names[first - 1] == "energy_balance" and names[first : first + 2] == ["place", "hold"]
    last = names.index("settle")
    assert names[last : last + 4] == ["settle", "total", "report_held", "fused"]
    assert names.count("place") == names.count("settle") == names.count("report_held")
    engine.run(3)
    records, reactions = engine.records_and_reactions()
    assert records["step"].tolist() == [1, 2, 3] and reactions.shape == (3, 2, 6)


def test_a_scene_on_a_gpu_is_explained(cupy):
    """Each effect has the twins of its arrays: gravity the three numbers of g, in the precision of the kernels."""
    found = explain("deploy/scenes/beam.toml", ["solver.precision=float32"], "gpu")
    asked = {each.name: each for each in found.asked}
    assert (asked["gravity"].bytes, asked["gravity"].device_bytes) == (24, 12)
    assert asked["corotational"].device_bytes > 0 and found.device == "gpu"
    assert asked["gravity"].kernels == {"effects/gravity.cu": ["gravity"]}
    owners = {row.kernel: row.asker for row in found.launches}
    assert owners["touch.apply"] == "touch" and owners["nodes.start"] == "core"


def test_an_effect_of_another_package_is_put_together_with_the_others(cupy, tmp_path, monkeypatch):
    """Its text, and the header beside it, compile in the kernel over nodes of the step."""
    install(tmp_path)
    with_own_header(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    sources = []
    made = cupy.RawModule
    monkeypatch.setattr(cupy, "RawModule", lambda **given: sources.append(given["code"]) or made(**given))
    beside = "object.block.effects.trap={pull=2.0}"
    (tmp_path / "scene.toml").write_text(
        'dt = 0.02\n[[object]]\nname = "block"\nmesh = { bar = [2, 2, 2], size = [1, 1, 1] }\n'
        "[object.effects]\ncorotational = { young = 1e5, poisson = 0.3 }\n"
    )
    simulation = Simulation.load(tmp_path / "scene.toml", [beside], "gpu")
    simulation.engine.run(2)
    assert "trap.pull" in [launch.name for launch in simulation.step_launches]
    assert any("::pull_item(" in code and "::gather" in code and "trap_law.cuh" in code for code in sources)
    assert len(build_id(simulation)) == 24


def test_the_build_does_not_depend_on_when_texts_of_factors_are_loaded(monkeypatch):
    """A server whose pattern of L is known loads them before it writes its log, others later."""
    monkeypatch.setattr(compiler, "libraries", set())
    simulation = Simulation.load("deploy/scenes/beam.toml", [], "gpu")
    before = build_id(simulation)
    for module in (digits, partition):
        module.library.cache_clear()
        module.library()
    assert build_id(simulation) == before
    assert {Path(text).name for text in device.LATER} <= set(compiler.compiled)
    monkeypatch.setattr(device, "LATER", device.LATER[:1])
    assert build_id(simulation) != before
