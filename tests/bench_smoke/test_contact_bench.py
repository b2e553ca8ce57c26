# SPDX-License-Identifier: MIT
"""What bench contact makes of motions and rows: penetration and creep, what each level carries, answers in short."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest

from sim_server.updates.driver import Driver
from tests.bench.contact import impact, ladder, page, pairs, peers, summary
from tests.bench.contact.bodies import DT, G, Row
from tests.bench.contact.units import KEYS, units
from tests.bench.harness.pieces import Piece

PEER = """
import json, sys
import numpy as np

problem = json.load(open(sys.argv[1]))
x = np.array([body["x"] for body in problem["bodies"]]).reshape(-1, 3)
speed, frame = problem["bodies"][0]["v"][0], problem["dt"] * problem["substeps"]
lost = problem["friction"] * 9.81
time = np.minimum(np.arange(1, problem["frames"] + 1) * frame, speed / lost if lost else np.inf)
moved = (speed * time - lost * time**2 / 2)[:, None, None] * [1, 0, 0]
weight = -sum(sum(body["mass"]) for body in problem["bodies"]) * problem["gravity"][1]
np.savez(sys.argv[2], x=x + moved - [0, 3e-4, 0], seconds=np.full(len(time), 2e-3), version="a peer 1",
         floor=np.full(len(time), weight), notes=json.dumps({"nodes": len(x)}))
"""


def way(folder: Path, script: str = PEER) -> peers.Way:
    """A peer whose Python is ours."""
    path = folder / "peer.py"
    path.write_text(script)
    return peers.Way("a peer", "2 steps a frame", 2, {}, str(path), "json")


def test_a_block_that_slides_as_a_rigid_one_does(tmp_path: Path) -> None:
    found = peers.row(peers.SLIDE, way(tmp_path), "cpu", sys.executable)
    assert found["version"] == "a peer 1" and json.loads(found["notes"]) == {"nodes": 7 * 4 * 6}
    assert found["known m"] == pytest.approx(1 / (2 * 0.5 * G) - DT / 4)
    assert found["stop m"] == pytest.approx(1 / (2 * 0.5 * G)) and found["creep mm/s"] == pytest.approx(0, abs=1e-9)
    assert (found["ms a frame"], found["ms a step"]) == pytest.approx((2.0, 1.0))
    free = peers.row(peers.FREE, way(tmp_path), "cpu", sys.executable)
    assert free["speed m/s"] == pytest.approx(1.0)


def test_depths_are_told_from_where_contact_begins(tmp_path: Path) -> None:
    drop = peers.row(peers.DROP, way(tmp_path), "cpu", sys.executable)
    assert drop["deepest mm"] == 0 and drop["at rest mm"] == pytest.approx(0.3 - 1e3 * peers.DROP.height)
    assert drop["floor / weight"] == pytest.approx(1.0)
    stack = peers.row(peers.STACK, way(tmp_path), "cpu", sys.executable)
    assert stack["floor mm"] == pytest.approx(0.3) and stack["between mm"] == pytest.approx(0, abs=1e-9)
    assert stack["stands"] == "yes"


def test_what_a_peer_says_last_is_why_it_failed(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="no such law"):
        peers.row(peers.DROP, way(tmp_path, "raise SystemExit('no such law')"), "cpu", sys.executable)


def test_a_peer_that_is_not_there_is_left_out(capsys: pytest.CaptureFixture[str]) -> None:
    assert peers.missing(None, "json") and not peers.missing(sys.executable, "json")
    assert peers.missing(sys.executable, "no_such_module") == "no no_such_module there"
    names = [u.name for u in units("cpu", (540,), False, None) if u.table == "peers"]
    assert names and all(name.startswith("peers ours") for name in names)
    said = capsys.readouterr().out
    assert "MuJoCo: left out" in said and "Newton VBD: left out" in said


def test_a_unit_has_a_name_of_its_own_and_a_gpu_has_others() -> None:
    names = [u.name for device in ("cpu", "gpu") for u in units(device, (540, 3000), False, None)]
    assert len(set(names)) == len(names)
    tables = {u.table for u in units("gpu", (540,), False, None)}
    assert {"answers", "cost", "few", "goals", "impact", "own", "peers", "pile"} == tables <= set(KEYS)


def test_ours_keeps_still_below_the_limit_of_friction() -> None:
    found = peers.row(peers.STEEP, peers.WAYS[0], "cpu")
    assert found["creep mm/s"] < 1e-3 and 0 < found["at rest mm"] < 0.2


def test_what_each_level_of_a_stack_carries() -> None:
    sim = pairs.stack(3)
    Driver(sim).advance(150)
    weight = float(sim.world.mass.sum()) * G / 3
    for level in (1, 2):
        assert pairs.carried(sim, level)[1] == pytest.approx((3 - level) * weight, rel=1e-3)


def curve(way: str, ms: float) -> Row:
    n = 20
    return {
        "device": "cpu", "tets": 3000, "preconditioner": way, "first": 4, "step": list(range(n)), "passes": [1] * n,
        "iterations": [0] * 4 + [30] * 6 + [1] * 10, "ms": [1.0] * 4 + [ms] * 6 + [2.0] * 10,
    }  # fmt: skip


def test_phases_of_an_impact() -> None:
    before, at, after = impact.phases(curve(impact.FACTOR, 9.0))
    assert [line["steps"] for line in (before, at, after)] == [4, 6, 10]
    assert (before["most"], at["most"], after["most ms"]) == (0, 30, 2.0) and at["p99 ms"] == 9.0


def test_pieces_may_come_in_any_order() -> None:
    lines = [
        {"device": "cpu", "tets": 540, "kappa": 1.0, "situation": situation, "preconditioner": way}
        for situation in ("rest", "impact without friction, before", "impact without friction, at", "tumbling")
        for way in (impact.FACTOR, impact.JACOBI)
    ]
    lines[3], lines[4] = lines[4], lines[3]  # of each way, what comes before the impact stands first
    assert page.ordered("cost", lines[::-1]) == lines
    thrown = [{"obstacle": name, "dt ms": 5.0, "speed": v} for name in ladder.OBSTACLES for v in ladder.SPEEDS]
    assert page.ordered("paths", thrown[::-1]) == thrown
    assert page.ordered("answers", lines[::-1]) == lines[::-1]


def test_the_page_begins_with_answers(tmp_path: Path) -> None:
    beside = {"device": "cpu", "who": peers.OURS, "settings": "default", "version": "", "notes": "", "dt ms": 16.7}
    tables: dict[str, list[dict[str, Any]]] = {
        "answers": [{"case": "a", "known": "1", "ours": "1", "error": 0.0, "at most": "1e-3", "holds": "yes"},
                    {"case": "b", "known": "1", "ours": "2", "error": 1.0, "at most": "1e-3", "holds": "**no**"},
                    {"case": "c", "known": "1", "ours": "1", "error": 0.0, "at most": "", "holds": ""}],
        "impact": [curve(impact.FACTOR, 9.0), curve(impact.NONE_IN_CONTACT, 7.0), curve(impact.JACOBI, 5.0)],
        "peers": [beside | {"case": peers.SLIDE.name, "stop m": 0.1, "known m": 0.1, "error": 0.01, "ms a frame": 0.2},
                  beside | {"case": peers.STEEP.name, "creep mm/s": 1e-8, "ms a frame": 0.2}],
    }  # fmt: skip
    answers = {row["asked"]: row["answer"] for row in summary.rows(tables)}
    assert answers["Is it right?"].startswith("1 of 2")
    assert "factor 9 ms; no factor while in contact 7 ms; block Jacobi 5 ms" in answers.values()
    assert any("stops +1 % off, creeps 1e-08 mm/s" in answer for answer in answers.values())
    page.write(Piece("contact", "Contact", {"device": "cpu"}, tmp_path, quick=True), tables)
    text = (tmp_path / "contact.md").read_text()
    assert text.index("| Is it right? |") < text.index("## Known answers") < text.index("## Beside others")
    assert "Not measured here: MuJoCo, Newton VBD." in text
    assert "| at | no factor while in contact | 6 | 30 | 30 | 7 | 7 | 7 |" in text
