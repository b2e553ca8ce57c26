# SPDX-License-Identifier: MIT
"""A run that is saved and goes on in another simulation, beside one that just goes on; on any device."""

from typing import Any

import numpy as np

from sim_server.checkpoint.content import capture, restore, restore_driver, saved_factors
from sim_server.checkpoint.file import from_bytes
from sim_server.simulation import Simulation
from sim_server.state.arrays import DERIVED, state_arrays
from sim_server.updates.driver import Driver
from tests.resets.state_scenes import made

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


def changed(sim: Simulation) -> None:
    """Halves one parameter of each effect that has any."""
    of = {p.field.of: p for p in sim.parameters if isinstance(p.field.value, float) and p.field.value}
    if of:
        sim.parameters.set({p.field.key: repr(p.field.value / 2) for p in of.values()})


def resumed(data: bytes, sim: Simulation) -> Driver:
    """A driver of the simulation, which goes on where the file was saved."""
    driver, checkpoint = Driver(sim), from_bytes(data)
    manifest = restore(sim, checkpoint)
    restore_driver(driver, manifest, saved_factors(sim, checkpoint, manifest))
    return driver


def spoil_derived(sim: Simulation) -> None:
    """Sets to NaN what is said to be made anew by each step before it is read."""
    for launch in sim.step_launches:
        for name, array in launch.written():
            if name in DERIVED and array.dtype == np.float64:
                array[...] = np.nan


def differing(a: Any, b: Any) -> list[str]:
    """Names of columns of records that differ, without those that a clock makes."""
    names = [name for name in a.dtype.names if name not in TIMED]
    return [n for n in names if not np.array_equal(a[n], b[n], equal_nan=a[n].dtype.kind == "f")]


def check_that_it_goes_on(name: str, update: str, device: str = "cpu") -> None:
    """One of SCENES: records, positions and memory agree to the bit."""
    sim = made(name, device, update=update)
    driver = Driver(sim)
    driver.advance(2)
    touched(sim)
    changed(sim)
    driver.advance(BEFORE - 2)
    data = capture(sim, driver, "test").to_bytes()
    records = driver.advance(AFTER)
    other = made(name, device, update=update)
    again = resumed(data, other)
    if device == "cpu":
        spoil_derived(other)
    assert other.engine.step == BEFORE
    assert differing(again.advance(AFTER), records) == []
    np.testing.assert_array_equal(other.fetch().x, sim.fetch().x)
    for a, b in zip(state_arrays(sim), state_arrays(other), strict=True):
        if not a.name.startswith("engine."):  # structs have padding, and times
            np.testing.assert_array_equal(a.read(), b.read(), err_msg=a.name)
