# SPDX-License-Identifier: MIT
"""A run that is saved, and goes on in another simulation, agrees to the bit with one that just goes on."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_server.checkpoint.content import capture, restore, restore_driver, saved_factors
from sim_server.checkpoint.file import from_bytes, read
from sim_server.errors import InputError
from sim_server.simulation import Simulation
from sim_server.state.arrays import state_arrays
from sim_server.updates.driver import Driver
from tests.resets.state_scenes import SCENES, made

TIMED = ("assemble", "solve", "integrate", "whole", "late", "begin", "cpu")
BEFORE, AFTER = 11, 9  # steps


def touched(sim: Simulation) -> None:
    """Grabs what can be grabbed, and moves what clients move."""
    for body in sim.world.bodies:
        if sim.touch is not None and "touch" in body.effects:
            x, y, z = sim.world.x[body.nodes].max(axis=0).tolist()
            sim.touch.grab("anna", body.name, (x, y, z), 0.0, (x, y + 0.1, z), 500.0, 100.0, 0.2)
    for mover in sim.movers:
        for name, pose in mover.targets.items():
            x, y, z = (pose[:3] + np.array([0.01, -0.2, 0])).tolist()
            mover.move(name, (x, y, z), (1.0, 0.0, 0.0, 0.0))


def saved(sim: Simulation, driver: Driver) -> bytes:
    return capture(sim, driver, "test").to_bytes()


def resumed(data: bytes, sim: Simulation) -> Driver:
    driver, checkpoint = Driver(sim), from_bytes(data)
    manifest = restore(sim, checkpoint)
    restore_driver(driver, manifest, saved_factors(sim, checkpoint, manifest))
    return driver


def same_records(a: Any, b: Any) -> list[str]:
    """Names of columns that differ."""
    names = [name for name in a.dtype.names if name not in TIMED]
    return [n for n in names if not np.array_equal(a[n], b[n], equal_nan=a[n].dtype.kind == "f")]


CASES = [(name, "every-3") for name in SCENES if name != "central_difference"] + [
    ("central_difference", "never"), ("bdf2", "lockstep-4"), ("friction", "lockstep-4"), ("ros2", "lockstep-3"),
    ("attached", "never"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "update"), CASES)
def test_a_run_goes_on_to_the_bit(name: str, update: str) -> None:
    sim = made(name, update=update)
    driver = Driver(sim)
    driver.advance(2)
    touched(sim)
    driver.advance(BEFORE - 2)
    data = saved(sim, driver)
    records = driver.advance(AFTER)
    other = made(name, update=update)
    again = resumed(data, other)
    assert other.engine.step == BEFORE
    assert same_records(again.advance(AFTER), records) == []
    np.testing.assert_array_equal(other.fetch().x, sim.fetch().x)
    for a, b in zip(state_arrays(sim), state_arrays(other), strict=True):
        if not a.name.startswith("engine."):  # structs have padding, and times
            np.testing.assert_array_equal(a.read(), b.read(), err_msg=a.name)


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
