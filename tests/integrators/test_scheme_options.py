# SPDX-License-Identifier: MIT
"""The [integrator] table: what is allowed, and that what is not asked for costs nothing."""

import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.scene import load
from sim_server.scene.integrator_options import IntegratorOptions
from sim_server.scene.model import Scene
from tests.scenes import bar, scene, simulation

SCENE = """dt = 0.01
[[object]]
name = "beam"
mesh = {{ bar = [2, 1, 1], size = [2, 1, 1] }}
[integrator]
{}
"""

BAD = {
    'scheme = "euler"': "integrator.scheme = 'euler': must be 'backward_euler', 'newmark', 'bdf2', "
    "'generalized_alpha', 'quasi_static', 'ros2' or 'central_difference'",
    "beta = 0.25": "beta belong to scheme newmark, not to backward_euler",
    'scheme = "newmark"\nbeta = 0.1': "newmark with beta = 0.1, gamma = 0.5 is stable for small steps only; "
    "allowed: 1/2 <= gamma <= 2 beta",
    'scheme = "newmark"\ngamma = 0.4': "integrator.gamma = 0.4: must be greater than or equal to 0.5",
    'scheme = "newmark"\nspectral_radius = 0.5': "spectral_radius belongs to scheme generalized_alpha, not to newmark",
    'scheme = "generalized_alpha"\nspectral_radius = 1.1': "integrator.spectral_radius = 1.1: must be less than or "
    "equal to 1",
    'scheme = "generalized_alpha"\ngamma = 0.6': "gamma belong to scheme newmark, not to generalized_alpha",
    "linearizations = 0": "integrator.linearizations = 0: must be greater than or equal to 1",
    "linearizations = 2.5": "integrator.linearizations = 2.5: must be a whole number",
    "tolerance = 0.0": "integrator.tolerance = 0.0: must be greater than 0",
    "newton = true": "unknown key .known keys: beta, error_bound, gamma, linearizations, scheme, solve, "
    "spectral_radius, tolerance, trials",
    "linearizations = 4\n[solver]\nbudget = 0.01": "a budget is for one solve a step; allowed: one of the two",
}


@pytest.mark.parametrize("table", BAD)
def test_mistakes_are_told(tmp_path, table):
    path = tmp_path / "bad.toml"
    path.write_text(SCENE.format(table))
    with pytest.raises(InputError, match=r"scene bad.toml[,:] .*" + BAD[table].replace("(", r"\(")):
        load(path)


UNSTABLE = {"tangent": "usual"}, {"rotation": "qr"}


@pytest.mark.parametrize("scheme", ["newmark", "bdf2", "generalized_alpha"])
@pytest.mark.parametrize("given", UNSTABLE, ids=str)
def test_a_tangent_with_which_the_energy_grows_is_refused(tmp_path, scheme, given):
    """The message names the object. More linearizations, or another scheme, allow it."""
    (key, value), path = next(iter(given.items())), tmp_path / "two.toml"
    body = '[[object]]\nname = "{}"\nmesh = {{ bar = [2, 1, 1], size = [2, 1, 1] }}\n'
    elastic = "[object.effects]\ncorotational = {{ young = 1e5, poisson = 0.3{} }}\n"
    bodies = body.format("good") + elastic.format("") + body.format("bad") + elastic.format(f', {key} = "{value}"')
    path.write_text(f'dt = 0.01\n[integrator]\nscheme = "{scheme}"\n{bodies}')
    words = rf"scene two.toml, object 'bad', effects.corotational: {key} = \"{value}\" with integrator.scheme = "
    with pytest.raises(InputError, match=words + rf"'{scheme}' and linearizations = 1 gains energy .* 2 or more$"):
        load(path)
    for other in ("linearizations=2", "scheme=backward_euler", "scheme=quasi_static"):
        made = load(path, [f"integrator.{other}"])
        assert [o.effects["corotational"].tangent for o in made.objects] == ["usual", "usual"]


@pytest.mark.parametrize("scheme", ["newmark", "bdf2", "generalized_alpha"])
def test_the_tangent_is_exact_where_it_must_be(scheme):
    bodies = bar(name="a"), bar(name="b", tangent="exact"), bar(name="c", young=None)
    made = scene(*bodies, integrator={"scheme": scheme})
    assert [o.effects["corotational"].tangent for o in made.objects[:2]] == ["exact", "exact"]
    assert Scene.model_validate(made.resolved()).resolved() == made.resolved()
    newton = scene(*bodies, integrator={"scheme": scheme, "linearizations": 2})
    assert [o.effects["corotational"].tangent for o in newton.objects[:2]] == ["usual", "exact"]


def test_negative_eigenvalues_by_default():
    """A given value holds; the default keeps a step with one linearization from overshooting."""
    chosen = {"linearizations": 1}, {"scheme": "bdf2"}, {"linearizations": 2}, {"scheme": "quasi_static"}
    assert [scene(bar(), integrator=i).projection for i in chosen] == ["excess", "excess", "clamp", "clamp"]
    assert scene(bar(), projection="absolute", integrator={"linearizations": 2}).projection == "absolute"


def test_a_gpu_without_loops_has_room_for_so_many_trials():
    IntegratorOptions(linearizations=113).check_unrolled()
    with pytest.raises(InputError, match=r"linearizations = 114 with trials = 8: .* 1026, .*; allowed: .* up to 1024"):
        IntegratorOptions(linearizations=114).check_unrolled()


def test_the_default_has_the_launches_of_backward_euler_alone():
    sim = simulation(bar(fixed="X < 0.01"))
    names = [launch.name for launch in sim.engine.launches]
    assert names[0] == "nodes.start" and names[-2:] == ["nodes.advance", "guess.extrapolate"]
    assert sim.world.damping_velocity is sim.world.v and sim.world.predictor is sim.world.v
    assert sim.engine.begin == [] and not sim.engine.loop.newton
    usual = simulation(bar(fixed="X < 0.01", tangent="usual"))
    assert [launch.name for launch in usual.engine.launches] == names
    exact = [launch.name for launch in simulation(bar(fixed="X < 0.01", tangent="exact")).engine.launches]
    other = simulation(bar(fixed="X < 0.01"), integrator={"scheme": "bdf2"})
    assert [launch.name for launch in other.engine.launches] == [
        "time_integration.inertia",
        *exact[1:-2],
        "time_integration.advance",
    ]


def test_a_scheme_starts_from_the_state_that_it_finds():
    """The history of the first step is made from x and v as a test or a program sets them before it."""
    runs = []
    for early in (True, False):
        sim = simulation(bar((3, 1, 1), (3, 1, 1), young=1e5), dt=0.01, tolerance=1e-10, integrator={"scheme": "bdf2"})
        if early:
            sim.world.v[:] = [1.0, 0.0, 2.0]
        sim.engine.assemble()
        sim.world.v[:] = [1.0, 0.0, 2.0]
        sim.engine.run(5)
        runs.append(sim.world.x.copy())
    assert np.array_equal(*runs)
    np.testing.assert_allclose(runs[0] - sim.world.rest, np.tile([0.05, 0, 0.1], (sim.world.nodes, 1)), atol=1e-9)
