# SPDX-License-Identifier: MIT
"""A beam cut by clients while it moves and a worker makes its factors: log, viewers, replay, reset."""

import json
import time
from pathlib import Path

import numpy as np
import pytest

from clients.client import Client
from clients.errors import BadInput
from clients.export.export import export
from clients.log.reader import Log
from clients.viewer.surface import Surface
from clients.web.feed import Link
from clients.web.surfaces import Surfaces
from tests.system.link_helpers import endpoint_of
from tests.system.server_process import fresh, run, until
from tests.system.test_replay_of_a_server import messages, recorded, replayed

pytestmark = pytest.mark.system
TETS = 3 * 3 * 10 * 6


def cut_about(client: Client) -> None:
    """A blade, a sphere, a region and numbers; what is refused; a cut under a grab."""
    until(lambda: fresh(client).step > 2, "it moves")
    client.pause()  # a command takes as long to start as all steps
    tip = client.meshes()["beam"]
    assert len(tip.tets) == TETS and tip.uncut is None
    with client.grab("beam", "tip", radius=0.5, stiffness=1e4) as held:
        reply = client.cut("beam", where="Z > 3.8 and X > 0.6")
        assert reply.removed > 0 and reply.left == TETS - reply.removed
        client.step(3)
        held.move((1, 2, 4))
        again = client.cut("beam", where="Z > 3.8 and X > 0.6")
        assert (again.removed, again.left) == (0, reply.left)
    where = ("--connect", endpoint_of(client))
    said = run("clients", "cut", "--object", "beam", "--sphere", "0.5", "0.5", "0.7", "0.4", "--json", *where)
    assert said.returncode == 0 and json.loads(said.stdout)["left"] < reply.left, said.stderr
    client.step(5)
    blade = "-5 -20 1.45, 5 -20 1.45, 5 20 1.45, -5 20 1.45"
    said = run("clients", "cut", "--object", "beam", "--blade", blade, *where)
    assert said.returncode == 0 and "elements removed" in said.stdout, said.stderr
    left = client.cut("beam", elements="0-2").left
    for bad, why in (
        ({}, "one of blade, radius, where and elements"), ({"where": "Q > 1"}, "Q"),
        ({"blade": [(0, 0, 0)]}, "1 corners"),
        ({"elements": "540"}, "from 0 to 539"), ({"elements": "a"}, "element numbers"),
        ({"elements": "0-9999999 " * 6000}, "no element 9999999"),
        ({"center": (0, 0, 0), "radius": 1e200}, "at most 1e"), ({"blade": [(1e300, 0, 0)] * 3}, "at most 1e"),
    ):  # fmt: skip
        with pytest.raises(BadInput, match=why):
            client.cut("beam", **bad)
    with pytest.raises(BadInput, match="no object 'liver'"):
        client.cut("liver", where="true")
    with pytest.raises(BadInput, match="removed by the command cut"):
        client.set("beam.cutting.removed", '""')
    assert not any("removed" in p.now.key for p in client.parameters()), "changed by a command of its own"
    client.resume()
    until(lambda: len(client.meshes()["beam"].tets) == left, "who asks is told what is left")
    assert fresh(client).objects[0].tets == left
    time.sleep(0.1)


def test_cuts_are_in_the_log_and_repeated_bit_for_bit(tmp_path: Path) -> None:
    log = recorded(tmp_path, touch=cut_about, effects="cutting = true\n")
    found = messages(log, "parameters")
    assert len(found) >= 3 and all(p.key.endswith("cutting.removed") for m in found for p in m.parameters)
    with Log(log) as opened:
        assert opened.complete
        meshes = opened.object_log("beam").meshes
        epochs = opened.object_log("beam").epochs
        assert epochs == sorted(epochs) and epochs[0] == 1 and len(set(epochs)) >= 3
        left = [len(meshes[e].tets) for e in sorted(set(epochs))]
        assert left == sorted(left, reverse=True) and left[0] == TETS > left[-1]
        last = meshes[epochs[-1]]
        assert last.uncut is meshes[1] and len(last.young) == left[-1]
        assert set(np.unique(Surface(last, "displacement").nodes)) <= set(np.unique(last.tets))
        to = tmp_path / "beam.npz"
        export(opened, "beam", to)
    with np.load(to) as arrays:
        assert arrays["tets"].shape == (TETS, 4) and len(arrays["x"]) == len(epochs)
        assert (arrays["removed_step"] > 0).sum() == TETS - left[-1]
    assert replayed(log, 0)["same"]


def reset_after_a_cut(client: Client) -> None:
    """With a page that watches."""
    link = Link(client.name, [endpoint_of(client)])
    try:
        surfaces = Surfaces(link.meshes)
        client.cut("beam", where="abs(Z - 2) < 0.3")
        until(lambda: (link.frames() and False) or link.take_meshes() == "cut", "the page hears of it by the frames")
        cut = surfaces.cut(link.meshes)
        assert len(link.meshes["beam"].tets) < TETS and len(cut.points) > len(surfaces.points), "inside is seen"
        assert np.array_equal(cut.nodes["beam"], surfaces.nodes["beam"])
    finally:
        link.close()
    client.reset("beam")
    until(lambda: len(client.meshes()["beam"].tets) == TETS, "it is whole again")
    client.cut("beam", where="Z > 3.5")


def test_a_reset_makes_whole_and_is_repeated(tmp_path: Path) -> None:
    log = recorded(tmp_path, touch=reset_after_a_cut, effects="cutting = true\n")
    assert replayed(log, 0)["same"]


def split_about(client: Client) -> None:
    """A blade into the beam, one through it, what is refused; workers go on with the new pattern."""
    until(lambda: fresh(client).step > 2 and fresh(client).objects[0].factors_used > 0, "a factor came")
    client.pause()
    whole = client.meshes()["beam"]
    into = [(-5, -20, 1.45), (0.5, -20, 1.45), (0.5, 20, 1.45), (-5, 20, 1.45)]
    reply = client.cut("beam", blade=into, split=True)
    assert (reply.removed, reply.left) == (0, TETS) and reply.opened > 0 and reply.copied > 0
    again = client.cut("beam", blade=into, split=True)
    assert (again.opened, again.copied) == (0, 0), "these faces are open"
    client.step(4)
    until(
        lambda: len(client.meshes()["beam"].triangles) == len(whole.triangles) + 2 * reply.opened, "its lips are seen"
    )
    where = ("--connect", endpoint_of(client))
    said = run("clients", "cut", "--object", "beam", "--split", "--where", "Z > 2.8", "--json", *where)
    assert said.returncode == 0 and json.loads(said.stdout)["copied"] == 16, said.stderr
    with pytest.raises(BadInput, match="more spare nodes"):
        client.cut("beam", where="X > 0.34 and X < 0.6 or Y > 0.4", split=True)
    with pytest.raises(BadInput, match="closed by reset"):
        client.set("beam.cutting.opened", '""')
    assert not any("opened" in p.now.key for p in client.parameters())
    client.step(5)
    assert client.cut("beam", where="Z > 3.9").removed >= 0
    client.resume()
    made = fresh(client).objects[0].factors_used
    until(lambda: fresh(client).objects[0].factors_used > made + 1, "factors of the split body come")
    assert fresh(client).objects[0].tets == len(client.meshes()["beam"].tets)


def test_splits_are_in_the_log_and_repeated_bit_for_bit(tmp_path: Path) -> None:
    log = recorded(tmp_path, touch=split_about, effects="cutting = { spare = 60 }\n")
    found = messages(log, "parameters")
    assert sum(p.key.endswith("cutting.opened") for m in found for p in m.parameters) == 2
    with Log(log) as opened:
        assert opened.complete
        frames = list(opened.frames("beam"))
        meshes = [opened.mesh("beam", frame.epoch) for frame in frames]
        assert len({frame.epoch for frame in frames}) >= 3
        assert len(np.unique(meshes[-1].tets)) > len(np.unique(meshes[0].tets))
        for frame, mesh in zip(frames, meshes, strict=True):
            edges = frame.x[mesh.tets[:, 1:]] - frame.x[mesh.tets[:, :1]]
            assert (np.linalg.det(edges) > 0).all() and len(mesh.rest) == len(frame.x), "copies are where they belong"
    assert replayed(log, 0)["same"]
