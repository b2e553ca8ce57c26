# SPDX-License-Identifier: MIT
"""A run that is saved, and goes on in another simulation, agrees to the bit with one that just goes on."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_server.checkpoint.content import capture, digest, restore
from sim_server.checkpoint.file import Checkpoint, from_bytes, read
from sim_server.errors import InputError
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.resets.going_on import check_that_it_goes_on, differing, resumed
from tests.resets.state_scenes import SCENES, made
from tests.scenes import bar, scene

CASES = [(name, "every-3") for name in SCENES if name != "central_difference"] + [
    ("central_difference", "never"), ("bdf2", "lockstep-4"), ("friction", "lockstep-4"), ("ros2", "lockstep-3"),
    ("attached", "never"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "update"), CASES)
def test_a_run_goes_on_to_the_bit(name: str, update: str) -> None:
    check_that_it_goes_on(name, update)


def test_a_checkpoint_of_a_version_with_another_default_goes_on_with_its_mesh() -> None:
    """Bars were split as "kuhn" where a scene did not say how; a scene that does not say so now is another."""
    table = {"name": "test", "dt": 0.02, "object": [bar((2, 2, 2), fixed="X < 0.01")]}
    sim = Simulation(Scene.model_validate(table))
    driver = Driver(sim)
    driver.advance(2)
    checkpoint = capture(sim, driver, "test")
    del checkpoint.manifest["resolved"]["object"][0]["mesh"]["split"]  # as such a version wrote it
    checkpoint.manifest["digest"] = digest(checkpoint.manifest["resolved"])
    data = checkpoint.to_bytes()
    again = Simulation(Scene.model_validate(table))
    restore(again, from_bytes(data))
    np.testing.assert_array_equal(again.fetch().x, sim.fetch().x)
    del table["object"][0]["mesh"]["split"]
    with pytest.raises(InputError, match=r"another scene \(object\[0\].mesh.split: saved with kuhn, here mirrored\)"):
        restore(Simulation(Scene.model_validate(table)), from_bytes(data))


def without_last_b(checkpoint: Checkpoint) -> bytes:
    """The file as versions wrote it that did not have this array."""
    names = [name for name in checkpoint.arrays if name.endswith("last_b")]
    assert len(names) == 1
    del checkpoint.arrays[names[0]]
    return checkpoint.to_bytes()


@pytest.mark.parametrize("name", ["newmark", "friction", "plasticity"])
def test_a_checkpoint_from_before_last_b_goes_on_to_the_bit_while_it_moves(name: str) -> None:
    """The array only tells whether a body rests."""
    sim = made(name)
    driver = Driver(sim)
    driver.advance(7)
    data, expected = without_last_b(capture(sim, driver, "test")), driver.advance(6)
    other = made(name)
    assert differing(resumed(data, other).advance(6), expected) == []
    np.testing.assert_array_equal(other.fetch().x, sim.fetch().x)


def test_a_checkpoint_from_before_last_b_comes_to_rest_again() -> None:
    """A body at rest is solved for once more at most, which leaves it there."""
    given = scene(
        bar((3, 1, 1), fixed="X < 0.01", damping=(5, 0)), gravity=(0, -9.81, 0), tolerance=1e-10, update="never"
    )
    sim = Simulation(given)
    driver = Driver(sim)
    while not (last := driver.advance(50)[-1])["at_rest"]:
        assert last["step"] < 20_000
    data = without_last_b(capture(sim, driver, "test"))
    other = Simulation(given)
    records = resumed(data, other).advance(10)
    assert records["at_rest"][1:].all() and (records["status"] == 0).all()
    np.testing.assert_allclose(other.fetch().x, sim.fetch().x, rtol=0, atol=1e-12)


def test_a_checkpoint_of_another_scene_or_a_damaged_one_is_refused(tmp_path: Path) -> None:
    sim = made("newmark")
    driver = Driver(sim)
    driver.advance(2)
    checkpoint = capture(sim, driver, "test")
    data = checkpoint.to_bytes()

    def refused(match: str, scene: str = "newmark", **changes: Any) -> None:
        changed = from_bytes(data)
        changed.manifest |= changes
        with pytest.raises(InputError, match=match):
            restore(made(scene), from_bytes(changed.to_bytes()))

    refused(r"of another scene \(integrator.scheme: saved with newmark, here bdf2\)", "bdf2")
    refused("step = 'many'", step="many")
    refused("made on a gpu", device="gpu")
    (tmp_path / "half").write_bytes(data[: len(data) // 2])
    (tmp_path / "other").write_text("not at all")
    for name in ("half", "other"):
        with pytest.raises(InputError, match=f"{name}: no checkpoint, or a damaged one"):
            read(tmp_path / name)
    missing = from_bytes(data)
    key = next(k for k in missing.arrays if k.endswith(".x"))
    missing.arrays[key] = missing.arrays[key][:-1]
    with pytest.raises(InputError, match=r"is float64 of shape \(19, 3\); expected: float64 of shape \(20, 3\)"):
        restore(made("newmark"), missing)
    del missing.arrays[key]
    with pytest.raises(InputError, match="is missing"):
        restore(made("newmark"), missing)
