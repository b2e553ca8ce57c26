# SPDX-License-Identifier: MIT
"""Tutorials work as they stand there: commands run, files are read, servers start and end."""

import csv
import json
import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from tests.docs import tutorials

pytestmark = [pytest.mark.system, pytest.mark.timeout(3 * tutorials.LONGEST)]
MORE_TIME = tutorials.Advice("more --minutes", "--minutes 0.5", "--minutes 5")


def test_first_five_minutes(tmp_path: Path) -> None:
    done = tutorials.run("first_five_minutes", tmp_path)
    with (done.folder / "tentacle.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) > 10 and max(float(row["work"]) for row in rows) > 0
    assert "gravity.g" in done.output


def test_own_mesh(tmp_path: Path) -> None:
    done = tutorials.run("own_mesh", tmp_path)
    assert "no group 'rot'" in done.output and "root (elements), soft (elements)" in done.output
    assert -60 < float(re.findall(r"^(-[\d.]+) mm$", done.output, re.MULTILINE)[0]) < -1
    assert (done.folder / "finger.vtu").exists()
    assert len(np.load(done.folder / "finger.npz")["x"]) == 301


def test_tissue(tmp_path: Path) -> None:
    done = tutorials.run("tissue", tmp_path)
    sags = [float(sag) for sag in re.findall(r"^\w+: sags by (\d+) mm$", done.output, re.MULTILINE)]
    assert len(sags) == 3 and sags == sorted(sags, reverse=True) and sags[0] > 1.2 * sags[2]
    assert "stable_neo_hookean" in done.output


def test_drag_from_python(tmp_path: Path) -> None:
    done = tutorials.run("drag_from_python", tmp_path)
    assert re.search(r"^positions at [\d.]+ s: \(117, 3\)$", done.output, re.MULTILINE)
    assert re.search(r"^force \[.*[1-9].*\] N at ", done.output, re.MULTILINE)
    assert float(re.findall(r"^moved by ([\d.]+) mm", done.output, re.MULTILINE)[0]) > 1


def test_log_and_replay(tmp_path: Path) -> None:
    done = tutorials.run("log_and_replay", tmp_path)
    assert re.search(r"^from step \d+ \['object.strip.effects.corotational.young = 4", done.output, re.MULTILINE)
    assert "diverged" not in done.output and np.load(done.folder / "strip.npz")["scalars/work"].max() > 0


def test_many_workers(tmp_path: Path) -> None:
    done = tutorials.run("many_workers", tmp_path)
    assert "helper" in done.output and "local-2" in done.output


def test_accuracy_against_time(tmp_path: Path) -> None:
    reader = tutorials.Reader(tmp_path, MORE_TIME)
    done = reader.read(tutorials.page("accuracy_against_time"))

    def points() -> int:
        return len(json.loads((done.folder / "measured" / "points.json").read_text())["points"])

    for _ in range(3):  # a full machine goes on where it was, with more time
        if points() < 2:
            reader.command("sim-client accuracy plank.toml --minutes 5 --duration 0.2 --out measured")
    assert points() > 1
    assert (done.folder / "plank.plan.toml").exists()


def test_every_tutorial_has_a_test() -> None:
    names = {path.stem for path in tutorials.FOLDER.glob("*.md")}
    assert names == {name.removeprefix("test_") for name in globals() if name.removeprefix("test_") in names}


def test_blocks_of_a_page() -> None:
    page = "x\n```toml\n# a.toml\ndt = 1\n```\n```sh\n# in a terminal of its own\nb\n```\n```\nc\n```\n"
    found = tutorials.blocks(page)
    assert [(block.language, block.file) for block in found] == [("toml", "a.toml"), ("sh", ""), ("", "")]
    assert found[1].text.startswith(tutorials.APART)


def test_a_reader_follows_the_advice_of_a_command_that_fails(tmp_path: Path) -> None:
    page = [tutorials.Block("sh", "test 2 = 3 || { echo too little >&2; exit 1; }; echo 3")]
    with pytest.raises(AssertionError, match="too little"):
        tutorials.Reader(tmp_path).read(page)
    (tmp_path / "again").mkdir()
    advice = tutorials.Advice("too little", "2 = 3", "3 = 3")
    assert tutorials.Reader(tmp_path / "again", advice).read(page).output == "3\n"


def test_a_command_that_fails_is_told(tmp_path: Path) -> None:
    with pytest.raises(AssertionError, match="no such thing"):
        tutorials.Reader(tmp_path).read([tutorials.Block("sh", "echo no such thing; exit 3")])


@pytest.mark.parametrize(("name", "script"), [("tissue", "range.py"), ("drag_from_python", "alone.py")])
def test_python_of_a_tutorial(
    name: str, script: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without the commands beside it: what needs no server, in this process."""
    for block in tutorials.blocks((tutorials.FOLDER / f"{name}.md").read_text()):
        if block.file:
            (tmp_path / block.file).write_text(block.text)
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(tmp_path / script))
    assert " mm" in capsys.readouterr().out
