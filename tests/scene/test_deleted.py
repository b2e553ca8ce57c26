# SPDX-License-Identifier: MIT
"""Keys and values of earlier versions: one sentence says what to write in their place."""

import pytest

from sim_server.errors import InputError
from sim_server.scene import deleted, load
from sim_server.scene.model import Scene

SCENE = """\
dt = 0.02
[[object]]
name = "beam"
mesh = { bar = [2, 1, 1], size = [2, 1, 1] }
[object.effects]
corotational = { young = 5e5, poisson = 0.4 }
"""


def message(tmp_path, *overrides):
    path = tmp_path / "beam.toml"
    path.write_text(SCENE)
    with pytest.raises(InputError) as error:
        load(path, overrides)
    return str(error.value)


@pytest.mark.parametrize("key", deleted.KEYS)
def test_a_deleted_key_is_named_with_what_to_write(tmp_path, key):
    assert message(tmp_path, f"{key}=0") == f"scene beam.toml, {key} = 0: no longer exists: {deleted.KEYS[key]}"


@pytest.mark.parametrize(("key", "value"), deleted.VALUES)
def test_a_deleted_value_is_named_with_what_to_write(tmp_path, key, value):
    advice = deleted.VALUES[key, value]
    assert message(tmp_path, f"{key}={value}") == f"scene beam.toml, {key} = {value!r}: no longer exists: {advice}"


def test_with_all_other_mistakes_at_once(tmp_path):
    overrides = [f"{key}={value}" for key, value in deleted.VALUES] + [f"{key}=0" for key in deleted.KEYS]
    lines = message(tmp_path, "solver.tolerance=2", *overrides).splitlines()
    keys = {key for key, _ in deleted.VALUES} | set(deleted.KEYS)
    assert len(lines) == 1 + len(keys) and sum("no longer exists" in line for line in lines) == len(keys)


def test_other_wrong_values_are_told_the_allowed_ones(tmp_path):
    assert message(tmp_path, "solver.schedule=fair").endswith("must be 'excess' or 'round_robin'")


@pytest.mark.parametrize("key", [*deleted.KEYS, *(key for key, _ in deleted.VALUES)])
def test_what_is_advised_is_what_scenes_have(key):
    """A table below a scene: what is deleted is no key of it, and a value's key is."""
    table, name = key.rsplit(".", 1)
    known = Scene.model_fields[table].default.__class__.model_fields
    assert (name in known) == (key not in deleted.KEYS)


@pytest.mark.parametrize("key", deleted.WITHOUT_EFFECT)
def test_scenes_of_older_logs_lose_deleted_keys_without_effect(key):
    table, name = key.rsplit(".", 1)
    older = {"dt": 0.02, table: {"kept": 1, name: deleted.WITHOUT_EFFECT[key]}}
    assert deleted.without(older) == {"dt": 0.02, table: {"kept": 1}}
    at_work = {"dt": 0.02, table: {name: 8}}
    assert deleted.without(at_work) == {"dt": 0.02, table: {name: 8}}, "is refused"
    assert deleted.without({"dt": 0.02}) == {"dt": 0.02} and deleted.without([]) == []
