# SPDX-License-Identifier: MIT
"""Compiled kernels are loaded only from where nobody else could have put them."""

import os
import shutil
from pathlib import Path

import pytest

from sim_server.backends import compiler
from sim_server.backends.build_pool import CompileError
from sim_server.backends.cache_trust import distrust

SOMEBODY = 12345
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="gives files to another user")


@pytest.fixture
def library(tmp_path: Path) -> Path:
    folder = tmp_path / "cache"
    folder.mkdir(mode=0o700)
    path = folder / "a.so"
    path.write_bytes(b"x")
    path.chmod(0o755)
    return path


def test_what_is_ours_alone_is_trusted(library: Path) -> None:
    assert distrust(library) == ""
    assert distrust(library.parent / "to_be_made.so") == ""


@pytest.mark.parametrize("mode", [0o722, 0o777, 0o1777, 0o702])
@pytest.mark.parametrize("what", ["folder", "library"])
def test_what_others_may_write_is_not(library: Path, what: str, mode: int) -> None:
    path = library if what == "library" else library.parent
    path.chmod(mode)
    assert f"{path} may be written by others" in distrust(library) and "chmod go-w" in distrust(library)


def test_a_folder_above_that_others_may_write_is_not_trusted_unless_sticky(library: Path) -> None:
    above = library.parent.parent
    above.chmod(0o777)
    assert f"{above} may be written by others" in distrust(library)
    above.chmod(0o1777)
    assert distrust(library) == ""


@as_root
@pytest.mark.parametrize("what", ["folder", "library", "above"])
def test_what_belongs_to_another_user_is_not(library: Path, what: str) -> None:
    path = {"library": library, "folder": library.parent, "above": library.parent.parent}[what]
    os.chown(path, SOMEBODY, SOMEBODY)
    assert f"{path} belongs to user {SOMEBODY}" in distrust(library)


def test_a_link_is_not(library: Path) -> None:
    link = library.with_name("b.so")
    link.symlink_to(library)
    assert "is no plain file" in distrust(link)


def test_the_group_of_the_user_alone_may_write(library: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With umask 002, as Ubuntu and Fedora have it."""
    library.chmod(0o775)
    monkeypatch.setattr("sim_server.backends.cache_trust.alone_in", lambda group: True)
    assert distrust(library) == ""
    monkeypatch.setattr("sim_server.backends.cache_trust.alone_in", lambda group: False)
    assert "may be written by others (mode 775)" in distrust(library)


def test_a_planted_library_is_not_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WARPFACTOR_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(compiler, "variant", lambda: None)
    source = tmp_path / "one.cpp"
    source.write_text('extern "C" int one() { return 1; }\n')
    made = compiler.build(source)
    assert made.parent.stat().st_mode & 0o777 == 0o700, "made for this user alone"
    made.parent.chmod(0o777)
    with pytest.raises(CompileError, match=r"compiled kernels are not loaded: .* may be written by others"):
        compiler.build(source)
    made.parent.chmod(0o700)
    assert compiler.build(source) == made
    planted = made.read_bytes()
    made.unlink()
    (tmp_path / "theirs.so").write_bytes(planted)
    made.symlink_to(tmp_path / "theirs.so")
    with pytest.raises(CompileError, match="is no plain file"):
        compiler.build(source)
    shutil.rmtree(made.parent)
