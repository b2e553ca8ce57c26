# SPDX-License-Identifier: MIT
"""A scene that does not list an effect is, to the bit, one of a build in which the effect does not exist."""

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from sim_server.effects import effect, known_effects
from tests.support.absent_effect import ask, copy_packages, start
from tests.support.effect_samples import SAMPLES, files_of, write_scene

CELLS, STEPS = (1, 1, 3), 8
EFFECTS = known_effects()


class Forks:
    """Reports of scenes, by processes that are forked of one."""

    def __init__(self, folder: Path):
        self.folder = folder
        copy_packages(folder)
        self._process: subprocess.Popen[str] = start(folder, "--forks")

    def of(self, name: str, listed: bool, without: list[str]) -> dict:
        """Report of the scene of an effect. listed: with it; without: files that are not there."""
        path = self.folder / f"{name}.toml"
        write_scene(path, name, CELLS, listed)
        return ask(self._process, json.dumps({"scene": str(path), "steps": STEPS, "without": without}))

    def close(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        assert self._process.wait() == 0


@pytest.fixture(scope="module")
def forks(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Forks]:
    made = Forks(tmp_path_factory.mktemp("packages"))
    yield made
    made.close()


def files(name: str, folder: Path) -> list[str]:
    """Module and texts of an effect; headers stay, as others would be compiled again without them."""
    there = [f.name for f in (folder / "sim_server" / "effects").iterdir() if f.suffix in (".py", ".cu")]
    return files_of(name, there, EFFECTS)


def test_every_effect_has_a_sample() -> None:
    assert set(EFFECTS) <= set(SAMPLES)
    assert all((effect(name).SCOPE == "scene") == SAMPLES[name].scene for name in EFFECTS)


@pytest.mark.parametrize("name", EFFECTS)
def test_a_scene_without_an_effect_is_one_of_a_build_without_it(forks: Forks, name: str) -> None:
    removed = files(name, forks.folder)
    assert f"{name}.py" in removed
    there, away = forks.of(name, False, []), forks.of(name, False, removed)
    assert "error" not in there, there
    assert there == away and there["folder"] == str(forks.folder)
    assert 1e-3 < there["moved"] < 1e2 and len(there["launches"]) > 3
    assert name not in there["asked"] and f"sim_server.effects.{name}" not in there["modules"]
    texts = {file.removesuffix(".cu") for file in removed}
    assert not texts & {launch.split(".")[0] for launch, _ in there["launches"]}
    assert not {f"{text}.cu" for text in texts} & set(there["texts"])


@pytest.mark.parametrize("name", EFFECTS)
def test_a_scene_with_it_has_it_and_cannot_be_built_without_its_file(forks: Forks, name: str) -> None:
    """So the scenes above lack something, and the files that are taken away are its own."""
    listed = forks.of(name, True, [])
    assert "error" not in listed, listed
    assert name in listed["asked"] and f"sim_server.effects.{name}" in listed["modules"]
    refused = forks.of(name, True, files(name, forks.folder))
    assert "no such effect" in refused["error"]
