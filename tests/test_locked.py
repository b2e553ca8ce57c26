# SPDX-License-Identifier: MIT
"""deploy/constraints.txt: every package that an extra needs, pinned, with hashes; deploy/locked.py finds them."""

import importlib.util
import re
import tomllib
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from types import ModuleType

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
LISTS = {**PROJECT["project"]["optional-dependencies"], **PROJECT["dependency-groups"]}
PIN = re.compile(r"^([a-z0-9.-]+)==([^ ;]+)(?: ; ([^\\]+))?", re.MULTILINE)


def _locked() -> ModuleType:
    spec = importlib.util.spec_from_file_location("locked", ROOT / "deploy" / "locked.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


locked = _locked()


@pytest.mark.parametrize("extra", LISTS)
def test_an_extra_is_locked_with_hashes(extra: str) -> None:
    text = locked.requirements([extra])
    pins = PIN.findall(text)
    for block in re.split(r"^(?=[a-z0-9.-]+==)", text, flags=re.MULTILINE)[1:]:
        first, *hashes = block.strip().split(" \\\n")
        assert hashes and all(re.fullmatch(r"\s+--hash=sha256:[0-9a-f]{64}", line) for line in hashes), first
    assert pins
    versions: dict[str, list[str]] = {}
    for name, version, _ in pins:
        versions.setdefault(name, []).append(version)
    for line in LISTS[extra]:
        wanted = Requirement(line)
        found = versions[locked.normal(wanted.name)]
        assert all(wanted.specifier.contains(version) for version in found), (line, found)


@pytest.mark.parametrize("extra", ["server", "test", "metrics"])
def test_all_is_there_that_the_installed_packages_ask_for(extra: str) -> None:
    """By another way than the notes of who needs what: metadata of what is installed here."""
    names = {name for name, _, _ in PIN.findall(locked.requirements([extra]))}
    for name in names:
        try:
            lines = requires(name) or []
        except PackageNotFoundError:  # of another platform, or not installed here
            continue
        for line in map(Requirement, lines):
            if line.marker is None or line.marker.evaluate({"extra": ""}):
                assert locked.normal(line.name) in names, f"{name} needs {line.name}"


def test_what_is_asked_for_and_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no extra nonsense; there are all, build"):
        locked.requirements(["nonsense"])
    (tmp_path / "deploy").mkdir()
    text = (ROOT / "pyproject.toml").read_text().replace('gym = ["', 'gym = ["newcomer>=1", "')
    (tmp_path / "pyproject.toml").write_text(text)
    (tmp_path / "deploy" / "constraints.txt").write_text((ROOT / "deploy" / "constraints.txt").read_text())
    with pytest.raises(ValueError, match=r"constraints\.txt lacks newcomer: its first lines say how to remake it"):
        locked.requirements(["gym"], tmp_path)


def test_what_nobody_needs_is_left_out() -> None:
    text = locked.requirements(["server"])
    assert "scipy==" in text and "numpy==" in text, "of the extra, and of the base"
    assert "matplotlib==" not in text and "pytest==" not in text
    assert set(name for name, _, _ in PIN.findall(locked.requirements(["build"]))) == {"cython", "setuptools"}


def test_set_up_installs_in_no_other_way() -> None:
    """pip is called once, without resolution, isolated builds or, for what is fetched, without hashes."""
    setup = (ROOT / "deploy" / "setup.sh").read_text()
    calls = [line for line in setup.splitlines() if re.search(r"-m pip\b.*\\$|pip_install ", line) and "#" not in line]
    assert setup.count("-m pip ") == 2, "pip_install, and a look whether pip runs"
    assert "--no-deps --no-build-isolation" in setup
    assert all("--require-hashes" in c or "--no-index" in c for c in calls if "pip_install " in c and "()" not in c)
