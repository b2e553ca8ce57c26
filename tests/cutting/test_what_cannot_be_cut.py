# SPDX-License-Identifier: MIT
"""What does not go together with cuts, or with the memory of materials, is refused with its reason."""

from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from sim_server.errors import InputError
from sim_server.scene.model import Scene
from tests.cutting.cut_scenes import made, table

TRACTION = {"traction": {"where": "X > 1.99", "pressure": 10.0}}
OTHER = {"name": "other", "mesh": {"bar": [1, 1, 1], "size": [0.5, 0.5, 0.5]}, "density": 1000.0,
         "pose": {"translate": [2.0, 0, 0]}, "elements": "linear",
         "effects": {"corotational": {"young": 2e5, "poisson": 0.4}}}  # fmt: skip
MEMORIES: dict[str, dict[str, Any]] = {
    "prony": {"terms": [{"g": 0.5, "tau": 0.1}]}, "plasticity": {"yield_stress": 1e4},
    "damage": {"strength": 1e4, "fracture_energy": 100.0}, "poroelasticity": {"mobility": 1e-10, "storage": 1e5},
}  # fmt: skip


GLUE = {"name": "glue", "object": "other", "to": "bar", "where": "X < 0.01"}
STATIC = {"integrator": {"scheme": "quasi_static"}, "solver": {}}


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"own": TRACTION}, "elements cannot be removed with the effect traction"),
        ({"own": {"prony": MEMORIES["prony"]}}, "elements cannot be removed with the effect prony"),
        ({"own": {"growth": {"expansion": 0.1}}}, "elements cannot be removed with the effect growth"),
        ({"object": [table()["object"][0], OTHER], "attachment": [GLUE]}, "with attachments or springs cannot be cut"),
        ({"object": [table()["object"][0], OTHER | {"elements": "smoothed"}]},
         "effect corotational, which object 'other' has, too: set its elements = \"linear\""),
        (STATIC, "need inertia, which the scheme quasi_static leaves out"),
    ],
    ids=["traction", "prony", "growth", "attachment", "other_elements", "quasi_static"],
)  # fmt: skip
def test_what_would_go_on_as_if_nothing_were_removed_is_refused(keys: dict[str, Any], says: str) -> None:
    with pytest.raises(InputError, match=says):
        made(**keys)


def test_a_body_with_a_skin_is_not_split(tmp_path: Path) -> None:
    skin = tmp_path / "skin.obj"
    skin.write_text("v 0.1 0.1 0.1\nv 1 0.1 0.1\nv 1 0.4 0.4\nf 1 2 3\n")
    with pytest.raises(InputError, match="an object with a skin is not split, which would stay whole"):
        made(own={"cutting": {"spare": 20}}, bar={"skin": str(skin)})
    made(bar={"skin": str(skin)})


@pytest.mark.parametrize("scheme", ["ros2", "central_difference"])
@pytest.mark.parametrize("name", MEMORIES)
def test_memories_are_refused_where_steps_ask_for_forces_of_several_instants(name: str, scheme: str) -> None:
    given = table(own={name: MEMORIES[name]}, integrator={"scheme": scheme}, solver={})
    del given["object"][0]["effects"]["cutting"]
    with pytest.raises(
        ValidationError, match=f"(?s)effects.{name}.*scheme = '{scheme}' has forces in between; allowed"
    ):
        Scene.model_validate(given)
